"""What long commands show: a bar while they run, lines of any width when they are done."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.progress import TaskID

__all__ = ["part_bars", "screen", "show", "ticking"]


@contextmanager
def ticking(what: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Show a progress bar; the function that it gives is called with the number of steps done."""
    from cucumbervision.cli.console import progress_bar

    with progress_bar(Console(stderr=True, highlight=False)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda count: bar.advance(task, count)


@contextmanager
def part_bars() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar for each part of a long run, on a terminal only.

    Yields
    ------
    callable
        Takes a part's name, how many of it were just finished and how many it has.
    """
    from cucumbervision.cli.console import progress_bar

    tasks: dict[str, TaskID] = {}
    with progress_bar(Console(stderr=True)) as bar:

        def report(name: str, count: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=total)
            bar.advance(tasks[name], count)

        yield report


def screen(width: int = 120) -> Console:
    """Return the standard output, as wide as `width` where it is no terminal and has no width."""
    return Console(highlight=False, width=None if Console().is_terminal else width)


def show(*lines: object, error: bool = False) -> None:
    """Print lines as they are: unwrapped, and without a meaning of brackets."""
    console = Console(stderr=error, highlight=False)
    for line in lines:
        console.print(str(line), soft_wrap=True, markup=False)
