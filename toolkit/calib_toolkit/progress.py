"""How long work says how far it is; the command draws bars, a program may do as it likes."""

from typing import Protocol


class Progress(Protocol):
    """Told of the parts of a job as they are done."""

    def begin(self, task: str, total: int, done: int = 0) -> None:
        """A task of so many units starts, some of them done before."""
        ...

    def advance(self, task: str, units: int) -> None:
        """So many more units of the task are done."""
        ...


class Silent:
    """Says nothing."""

    def begin(self, task: str, total: int, done: int = 0) -> None:
        """Nothing."""

    def advance(self, task: str, units: int) -> None:
        """Nothing."""
