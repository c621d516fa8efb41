"""What a training looks like on screen: a bar for the epoch, and a line for each that is done."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from cucumbervision_lab.training.train import EpochReport

__all__ = ["TrainConsole", "epoch_line"]

_SHOWN = (
    ("metrics/mAP50-95(B)", "box mAP"),
    ("metrics/mAP50-95(M)", "mask mAP"),
    ("metrics/mAP50-95(P)", "points mAP"),
    ("metrics/precision(B)", "precision"),
    ("metrics/recall(B)", "recall"),
)


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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
