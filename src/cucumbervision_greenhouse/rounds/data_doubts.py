"""Doubts about the data of a round, in the words of the command `measure`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.methods.table import AVAILABLE
from cucumbervision.run.fields import table_row
from cucumbervision.run.summary import Summary
from cucumbervision_greenhouse.store.records import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision.run.fields import Cell
    from cucumbervision_greenhouse.store.records import FruitRow


def round_doubts(views: Iterable[FruitRow]) -> list[str]:
    """Return the doubts about the fruit of a round, one line each with the remedy.

    Rejected ones are left out.
    """
    summary = Summary()
    summary.add(_row(view) for view in views if view.verdict is not Verdict.REJECTED)
    return summary.doubts()


def _row(view: FruitRow) -> dict[str, Cell]:
    row = table_row(vars(view))
    is_measured = any(row[f"{method.lower()}_cm"] is not None for method in AVAILABLE)
    return {**row, "reason": row["reason"] if is_measured else "", "simulated": False}
