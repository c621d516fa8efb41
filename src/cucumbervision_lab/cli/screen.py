"""Progress bars and unwrapped output of commands."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

from cucumbervision.cli.console import print_table, progress_bar, screen

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from rich.progress import TaskID

    from cucumbervision.accuracy.table import ReportTable
    from cucumbervision_lab.training.train import EpochReport

_SHOWN = (
    ("metrics/mAP50-95(B)", "box mAP"),
    ("metrics/mAP50-95(M)", "mask mAP"),
    ("metrics/mAP50-95(P)", "points mAP"),
    ("metrics/precision(B)", "precision"),
    ("metrics/recall(B)", "recall"),
)


@contextmanager
def ticking(what: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Show a progress bar; yields a function that is called with the number of completed steps."""
    with progress_bar(Console(stderr=True, highlight=False)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda count: bar.advance(task, count)


@contextmanager
def part_bars() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar for each step of a long run, on a terminal only.

    Yields
    ------
    callable
        Called with the name of the step, the number of finished items since the last call, and
        their total.
    """
    tasks: dict[str, TaskID] = {}
    with progress_bar(Console(stderr=True)) as bar:

        def report(name: str, count: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=total)
            bar.advance(tasks[name], count)

        yield report


def show_tables(tables: Iterable[ReportTable]) -> None:
    """Print the tables of a report."""
    console = screen(150)
    for table in tables:
        print_table(console, table)


def show(*lines: object, error: bool = False) -> None:
    """Print lines without wrapping and markup."""
    console = Console(stderr=error, highlight=False)
    for line in lines:
        console.print(str(line), soft_wrap=True, markup=False)


class TrainConsole:
    """Training callbacks that show a progress bar; use as a context manager."""

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
            transient=True,
        )
        self._task = self._bar.add_task("preparing", total=1.0)

    def __enter__(self) -> TrainConsole:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def batch(self, fraction: float, size_px: int) -> None:
        """Update the progress bar."""
        self._bar.update(self._task, completed=fraction, description=f"epoch at {size_px} px")

    def epoch(self, report: EpochReport) -> None:
        """Print the line of a completed epoch."""
        self._bar.reset(self._task)
        self._console.print(epoch_line(report), soft_wrap=True)

    def log(self, line: str) -> None:
        """Print a line."""
        self._console.print(line, soft_wrap=True, markup=False)

    def close(self, network: Path) -> None:
        """Print the path of the weights."""
        where = str(network) if network.is_file() else "none, no epoch has completed yet"
        Console(highlight=False).print(f"weights: {where}", soft_wrap=True)


def epoch_line(report: EpochReport) -> str:
    """Format an epoch report as one line.

    Examples
    --------
    >>> from cucumbervision_lab.training.train import EpochReport
    >>> epoch_line(EpochReport(1500, 20000, 448, 41.2, {"metrics/mAP50-95(B)": 0.5123}))
    '1500 of 20000 pictures  448 px  41 s  box mAP 0.512'
    """
    parts = [
        f"{report.pictures} of {report.of} pictures",
        f"{report.size_px} px",
        f"{report.seconds:.0f} s",
    ]
    losses = sum(v for k, v in report.metrics.items() if k.startswith("train/"))
    if losses:
        parts.append(f"loss {losses:.3f}")
    parts += [f"{name} {report.metrics[key]:.3f}" for key, name in _SHOWN if key in report.metrics]
    return "  ".join(parts)
