"""The one family of errors that users see: each a sentence that says what to do."""

import re


class CalibrationError(Exception):
    """Root of every refusal: one sentence that names the file, the sensor, the frame and the remedy.

    The command prints it as it is and exits with status 1. Of words in it that are endless only the ends are kept:
    a damaged file may hold thousands of digits in a row.
    """

    def __str__(self) -> str:
        return re.sub(r"(\S{60})\S{900,}(\S{40})", r"\1...\2", super().__str__())


class DataError(CalibrationError):
    """A recording, or a part of it, can not be used."""


class PluginError(CalibrationError):
    """A plugin is broken, or two plugins claim the same id."""


class ConfigError(CalibrationError):
    """An option has no such name or no such value."""


class NotObservableError(CalibrationError):
    """The drive says nothing about what was asked."""
