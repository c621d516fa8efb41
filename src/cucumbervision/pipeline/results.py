"""What one run gave: rows and failures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cucumbervision.pipeline.rows import Cell

__all__ = ["Failure", "RunResult"]


@dataclass(frozen=True)
class Failure:
    """An input or a capture that could not be read, in one line."""

    input: str
    capture: str
    error: str
    message: str


@dataclass(frozen=True, eq=False)
class RunResult:
    """What one run gave.

    Parameters
    ----------
    rows : list of dict
        One a fruit, as `session.rows.fruit_row` fills them.
    failures : list of Failure
        What could not be read; the rest was measured.
    captures : int
        How many captures were measured, those without fruit included.
    out : Path
        Where the files are.
    """

    rows: list[dict[str, Cell]] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    captures: int = 0
    out: Path = Path()
