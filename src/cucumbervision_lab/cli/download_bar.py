"""A download's progress on the screen."""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

__all__ = ["DownloadBar"]


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
