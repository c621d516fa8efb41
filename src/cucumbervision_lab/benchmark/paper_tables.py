"""The paper's own tables, beside the same protocol here."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.records import Masks, Record, Suite
from cucumbervision.accuracy.sections import Section
from cucumbervision.accuracy.statistics import bootstrap_mean, score
from cucumbervision.accuracy.table import Cell, Column, Table
from cucumbervision.accuracy.tables import (
    PAPER_METHODS,
    Truth,
    length_and_error,
    readings,
    span_text,
)
from cucumbervision_lab.benchmark.paper import PAPER_BENCHMARK, PAPER_VALIDATION

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["paper_sections", "paper_table", "paper_validation_table"]


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
    columns = (
        Column("method"),
        Column("whose"),
        Column("MAE (cm)"),
        Column("RMSE (cm)"),
        Column("MAPE (%)"),
        Column("95 % by capture (%)"),
        Column("median error (cm)"),
        Column("R²"),
    )
    rows: list[tuple[Cell, ...]] = []
    for method in (*PAPER_METHODS, "M6 thread"):
        rows += _printed(method)
        for masks in kinds:
            rows += _here([r for r in protocol if r.masks is masks], method, masks)
    comment = (
        "'The paper': what it prints for 48 captures of seven cucumbers of its own. 'Here': the "
        "same protocol, simulated, against the thread as in the paper. The paper's captures are "
        "not published, so that the two stand side by side and cannot be compared fruit by "
        "fruit. Its intervals for M1 and M5 are left out: one does not contain its own mean, the "
        "other is printed in two ways."
    )
    title = "The paper's figures, on its own captures, beside ours"
    return Table(title, columns, tuple(rows), comment)


def _printed(method: str) -> list[tuple[Cell, ...]]:
    one = PAPER_BENCHMARK.get(method)
    if one is None:
        return []
    interval = span_text(one.interval_percent)
    errors = (one.mae_cm, one.rmse_cm, one.mape_percent, interval, one.median_cm, one.r2)
    return [(method, "the paper", *errors)]


def _here(records: Sequence[Record], method: str, masks: Masks) -> list[tuple[Cell, ...]]:
    read = readings(records, method, Truth.THREAD)
    if not read.fruit:
        return []
    found = score(read.lengths_m, read.truth_m)
    errors = (
        found.mae_cm,
        found.rmse_cm,
        found.mape_percent,
        span_text(bootstrap_mean(read.errors_percent)),
        float(np.median(read.errors_cm)),
        found.r2,
    )
    return [(method, f"here, {masks} outlines", *errors)]


def paper_sections(records: Sequence[Record], note: str) -> list[Section]:
    """Return the section that puts the paper's figures beside these; none without its protocol.

    Parameters
    ----------
    records : sequence of Record
        Of any suites.
    note : str
        What to say first, paragraphs parted by an empty line.
    """
    beside = paper_table(records)
    if beside is None:
        return []
    entries = [beside]
    if any(r.suite is Suite.VALIDATION for r in records):
        entries.append(paper_validation_table())
    intro = tuple(note.split("\n\n")) if note else ()
    return [Section("Beside the paper", intro, tuple(entries))]
