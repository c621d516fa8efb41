"""Commands of the laboratory, and what they print."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rich.progress import TaskID

    from cucumbervision.accuracy.statistics import ReportTable
    from cucumbervision_lab.arrays import Progress


@contextmanager
def ticking(what: str, total: int | None = None) -> Iterator[Progress]:
    """Show a progress bar; yields a function that is called with the number of completed steps."""
    with part_bars() as report:
        yield lambda count: report(what, count, total)


@contextmanager
def part_bars() -> Iterator[Callable[[str, int, int | None], None]]:
    """Show a progress bar for each step of a long run, on a terminal only.

    Yields
    ------
    callable
        Called with the name of the step, the number of finished items since the last call, and
        their total.
    """
    from rich.console import Console

    from cucumbervision.cli.console import progress_bar

    tasks: dict[str, TaskID] = {}
    with progress_bar(Console(stderr=True)) as bar:

        def report(name: str, count: int, total: int | None) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=total)
            bar.advance(tasks[name], count)

        yield report


def show_tables(tables: Iterable[ReportTable]) -> None:
    """Print the tables of a report."""
    from cucumbervision.cli.console import print_table, screen

    console = screen(150)
    for table in tables:
        print_table(console, table)


def show(*lines: object, error: bool = False) -> None:
    """Print lines without wrapping and markup."""
    from rich.console import Console

    console = Console(stderr=error, highlight=False)
    for line in lines:
        console.print(str(line), soft_wrap=True, markup=False)
