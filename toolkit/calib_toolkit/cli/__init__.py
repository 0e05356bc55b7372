"""The command ``calib-toolkit``: subcommands are imported when they are called, so that ``--help`` is instant.

Exit statuses: 0 done; 1 refused, with one sentence; 2 wrong usage; 3 done, but data were skipped or something
is wrong or not determined; 130 interrupted.
"""

import os
from importlib import import_module
from importlib.metadata import entry_points
from keyword import iskeyword
from typing import Any

import click

from calib_toolkit.errors import CalibrationError, PluginError

COMMANDS = {
    "run": "Calibrate the sensors of a drive.",
    "inspect": "Show what a recording holds and what is wrong with it.",
    "convert": "Write a recording in another format.",
    "check": "Tell whether small moves would improve a calibration.",
    "compare": "Tell whether two results of one rig agree.",
    "export": "Write a calibration in the format of another program.",
    "import": "Read a calibration from the format of another program.",
    "evaluate": "Repeat the paper's experiments on drives whose truth is known.",
    "plugins": "List what is installed, and where from.",
    "demo": "Calibrate a simulated drive and show truth beside estimate.",
}
"""Name of each command, which is its module here and the function in it, and what it does in one line."""
PLUGINS = "calib_toolkit.commands"
"""Entry points under which plugins add commands: a name, and a click command that imports nothing heavy."""


class LazyGroup(click.Group):
    """A group that imports a command only to run it, and turns every error into one line on stderr."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The toolkit's own, in the order in which one meets them, then those that plugins add."""
        return [*COMMANDS, *sorted(entry_points(group=PLUGINS).names - COMMANDS.keys())]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name, imported now, or None if there is none. Raises PluginError."""
        if cmd_name in COMMANDS:
            name = f"{cmd_name}_" if iskeyword(cmd_name) else cmd_name
            command: click.Command = getattr(import_module(f"calib_toolkit.cli.{name}"), name)
            return command
        for point in entry_points(group=PLUGINS, name=cmd_name):
            try:
                added: click.Command = point.load()
                return added
            except Exception as e:
                raise PluginError(
                    f"the command '{cmd_name}' ({point.value}) could not be loaded ({type(e).__name__}: {e}); mend "
                    "or uninstall its plugin"
                ) from e
        return None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list of commands in ``--help``, importing only those of plugins."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, self._help(ctx, name)) for name in self.list_commands(ctx)])

    def _help(self, ctx: click.Context, name: str) -> str:
        if name in COMMANDS:
            return COMMANDS[name]
        try:
            command = self.get_command(ctx, name)
        except PluginError:
            return "(its plugin can not be loaded)"
        return command.get_short_help_str(100) if command else ""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command. A refusal exits with 1, an interrupt with 130; ``--debug`` lets tracebacks through."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.Abort, click.exceptions.Exit, BrokenPipeError):
            raise  # click's own business
        except KeyboardInterrupt:
            _exit(ctx, 130, "interrupted; finished work is kept, the same command goes on from there")
        except Exception as e:
            if ctx.params.get("debug"):
                raise
            if isinstance(e, CalibrationError):
                _exit(ctx, 1, str(e))
            what = " ".join(f"{type(e).__name__}: {e}".split())
            _exit(ctx, 1, f"unexpected {what} (calib-toolkit --debug {ctx.invoked_subcommand} ... shows where)")


def _exit(ctx: click.Context, status: int, sentence: str) -> None:
    click.echo(f"calib-toolkit: {sentence}", err=True)
    ctx.exit(status)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="calib-toolkit", message="%(prog)s %(version)s")
@click.option("--debug", is_flag=True, help="Show the whole traceback of an error.")
def main(debug: bool) -> None:
    """Extrinsics, clock offsets and their uncertainty of a vehicle's sensors, from an ordinary drive."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")  # matrices are small, and processes are the parallelism
