"""Tables of figures on screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from cucumbervision.accuracy.page import Table

__all__ = ["figures_console", "print_table"]

WIDTH = 150


def figures_console() -> Console:
    """Return the console for figures.

    A file or a pipe has no width of its own; 80 columns would cut the tables.
    """
    from rich.console import Console

    return Console(highlight=False, width=None if Console().is_terminal else WIDTH)


def print_table(console: Console, figures: Table) -> None:
    """Print a report's table, and its comment below."""
    from rich.table import Table

    table = Table(title=figures.title, title_justify="left")
    for column, numeric in zip(figures.columns, figures.numeric, strict=True):
        table.add_column(column.head, justify="right" if numeric else "left")
    for row in figures.text_rows():
        table.add_row(*row)
    console.print(table)
    if figures.comment:
        console.print(figures.comment, soft_wrap=True, markup=False, style="dim")
