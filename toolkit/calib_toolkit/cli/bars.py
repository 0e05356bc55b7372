"""Progress bars with rate and time left, on the terminal's error stream."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.text import Text


class Bars:
    """One bar a task (see :class:`calib_toolkit.progress.Progress`)."""

    def __init__(self, rich: RichProgress) -> None:
        self._rich = rich
        self._ids: dict[str, TaskID] = {}

    def begin(self, task: str, total: int, done: int = 0) -> None:
        """Show the task's bar."""
        self._ids[task] = self._rich.add_task(task, total=total, completed=done)

    def advance(self, task: str, units: int) -> None:
        """Move it."""
        self._rich.advance(self._ids[task], units)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.0f}/s" if speed else "")


@contextmanager
def bars() -> Iterator[Bars]:
    """Bars for as long as the work lasts."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    with RichProgress(*columns, console=Console(stderr=True)) as rich:
        yield Bars(rich)
