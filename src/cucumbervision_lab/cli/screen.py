"""Output of long commands: progress bars while they run, lines of any width when they are done."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from cucumbervision.cli.console import print_table, progress_bar, screen

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from rich.progress import TaskID

    from cucumbervision.accuracy.table import Table
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
    """Show a progress bar; the function that it gives is called with the number of steps done."""
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
    tasks: dict[str, TaskID] = {}
    with progress_bar(Console(stderr=True)) as bar:

        def report(name: str, count: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=total)
            bar.advance(tasks[name], count)

        yield report


def show_tables(tables: Iterable[Table]) -> None:
    """Print a report's tables."""
    console = screen(150)
    for table in tables:
        print_table(console, table)


def show(*lines: object, error: bool = False) -> None:
    """Print lines as they are: unwrapped, and without a meaning of brackets."""
    console = Console(stderr=error, highlight=False)
    for line in lines:
        console.print(str(line), soft_wrap=True, markup=False)


class TrainConsole:
    """Shows a training; a context, so that the bar goes when it ends."""

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
        self._task = self._bar.add_task("getting ready", total=1.0)

    def __enter__(self) -> TrainConsole:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def batch(self, fraction: float, size_px: int) -> None:
        """Move the bar."""
        self._bar.update(self._task, completed=fraction, description=f"epoch at {size_px} px")

    def epoch(self, report: EpochReport) -> None:
        """Write the epoch's line."""
        self._bar.reset(self._task)
        self._console.print(epoch_line(report), soft_wrap=True)

    def say(self, line: str) -> None:
        """Write a line of its own."""
        self._console.print(line, soft_wrap=True, markup=False)

    def close(self, network: Path) -> None:
        """Say where the weights are."""
        where = str(network) if network.is_file() else "none yet: no epoch is through"
        Console(highlight=False).print(f"weights: {where}", soft_wrap=True)


def epoch_line(report: EpochReport) -> str:
    """Put an epoch into one readable line.

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


class DownloadBar:
    """Rich's bar behind the methods that pooch calls: `total`, `update`, `reset`, `close`.

    Parameters
    ----------
    title : str
        What is fetched.
    """

    def __init__(self, title: str) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            DownloadColumn(),
            TransferSpeedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task(title, total=None)
        self._total = 0

    @property
    def total(self) -> int:
        """Size of the file in bytes; setting it shows the bar."""
        return self._total

    @total.setter
    def total(self, size_bytes: int) -> None:
        self._total = size_bytes
        self._progress.update(self._task, total=size_bytes)
        self._progress.start()

    def update(self, size_bytes: int) -> None:
        """Count bytes that have come."""
        self._progress.advance(self._task, size_bytes)

    def reset(self) -> None:
        """Count from the start again."""
        self._progress.update(self._task, completed=0)

    def close(self) -> None:
        """Leave the bar on the screen as it is."""
        self._progress.stop()
