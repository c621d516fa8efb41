"""The paper's own tables, beside the same protocol here."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.evaluation.metrics import score
from cucumbervision.evaluation.paper import PAPER_BENCHMARK, PAPER_VALIDATION
from cucumbervision.evaluation.records import Masks, Record, Suite
from cucumbervision.evaluation.table import Cell, Column, Table
from cucumbervision.evaluation.tables import (
    PAPER_METHODS,
    Truth,
    length_and_error,
    readings,
    span_text,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.evaluation.metrics import Metrics

__all__ = ["paper_table", "paper_validation_table"]


def paper_validation_table() -> Table:
    """Set out the paper's own validation table, less M5's column."""
    methods = PAPER_METHODS[:4]
    columns = (
        Column("fruit"),
        Column("true thread (cm)"),
        *(Column(f"{method} (cm)") for method in methods),
    )
    rows: list[tuple[Cell, ...]] = []
    for one in PAPER_VALIDATION:
        true_m = one.thread_cm / 100
        cells = [length_and_error(one.lengths_cm[method] / 100, true_m) for method in methods]
        rows.append((one.name, one.thread_cm, *cells))
    scores = [
        score(
            [one.lengths_cm[method] / 100 for one in PAPER_VALIDATION],
            [one.thread_cm / 100 for one in PAPER_VALIDATION],
        )
        for method in methods
    ]
    rows.append(("MAE (cm)", None, *[m.mae_cm for m in scores]))
    rows.append(("MAPE (%)", None, *[m.mape_percent for m in scores]))
    comment = (
        "The paper's readings of its own five fruit. Its column for M5 is left out: it prints an "
        "error of exactly 0.00 for all five, which no measurement gives."
    )
    return Table("The paper's validation fruit, on its own captures", columns, tuple(rows), comment)


def paper_table(records: Sequence[Record]) -> Table | None:
    """Put the paper's figures beside those of the same protocol here, against the thread.

    Returns
    -------
    Table or None
        None without records of the paper's protocol.
    """
    protocol = [r for r in records if r.suite is Suite.PAPER]
    kinds = [masks for masks in Masks if any(r.masks is masks for r in protocol)]
    if not kinds:
        return None
    columns = [Column("method")]
    columns += [Column(f"the paper's {name}") for name in _FIGURES[:3]]
    columns += [Column("the paper's 95 % (%)"), Column("the paper's R²")]
    columns += [Column(f"{name} here, {masks} masks") for masks in kinds for name in _FIGURES]
    rows: list[tuple[Cell, ...]] = []
    for method in (*PAPER_METHODS, "M6 thread"):
        here: list[Cell] = []
        for masks in kinds:
            here += _figures([r for r in protocol if r.masks is masks], method)
        rows.append((method, *_printed(method), *here))
    comment = (
        "Left: what the paper prints for 48 captures of seven cucumbers of its own. Right: the "
        "same protocol here, simulated, against the thread as in the paper. The paper's captures "
        "are not published, so that the two stand side by side and cannot be compared fruit by "
        "fruit. Its intervals for M1 and M5 are left out: one does not contain its own mean, the "
        "other is printed in two ways."
    )
    title = "The paper's figures, on its own captures, beside ours"
    return Table(title, tuple(columns), tuple(rows), comment)


_FIGURES = ("MAE (cm)", "RMSE (cm)", "MAPE (%)", "R²")


def _printed(method: str) -> list[Cell]:
    one = PAPER_BENCHMARK.get(method)
    if one is None:
        return [None] * 5
    interval = span_text(one.interval_percent)
    return [one.mae_cm, one.rmse_cm, one.mape_percent, interval, one.r2]


def _figures(records: Sequence[Record], method: str) -> list[Cell]:
    read = readings(records, method, Truth.THREAD)
    if not read.fruit:
        return [None] * len(_FIGURES)
    found: Metrics = score(read.lengths_m, read.truth_m)
    return [found.mae_cm, found.rmse_cm, found.mape_percent, found.r2]
