"""The one family of errors that users see: each a sentence that says what to do."""


class CalibrationError(Exception):
    """Root of every refusal: one sentence that names the file, the sensor, the frame and the remedy.

    The command prints it as it is and exits with status 1.
    """


class DataError(CalibrationError):
    """A recording, or a part of it, can not be used."""


class PluginError(CalibrationError):
    """A plugin is broken, or two plugins claim the same id."""


class ConfigError(CalibrationError):
    """An option has no such name or no such value."""


class NotObservableError(CalibrationError):
    """The drive says nothing about what was asked."""
