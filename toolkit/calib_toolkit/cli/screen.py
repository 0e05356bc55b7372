"""Where tables are printed."""

from os import environ

from rich.console import Console

WIDE = 1000
"""Columns of a file or a pipe, in which nobody wants a path or a number broken."""


def screen(markup: bool = True) -> Console:
    """Standard output: as wide as the terminal, or as COLUMNS says; with neither so wide that no line is broken."""
    console = Console(highlight=False, markup=markup)
    told = console.is_terminal or environ.get("COLUMNS")
    return console if told else Console(highlight=False, markup=markup, width=WIDE)
