"""The benchmark's tables: the paper's figures, then every suite; and the file of an evaluation."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from cucumbervision.accuracy.statistics import estimate, score
from cucumbervision.accuracy.table import Cell, ReportTable
from cucumbervision.errors import CucumberVisionError
from cucumbervision.files import write_json
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.length_tables import (
    PAPER_METHODS,
    accuracy_table,
    comparable_readings,
    group_tables,
    span_text,
    truths_of,
)
from cucumbervision_lab.benchmark.records import Masks

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    import pandas as pd

_SUITES = {
    Suite.PAPER: "The paper's protocol",
    Suite.VALIDATION: "The five validation fruit",
    Suite.STRESS: "The stress set",
}
_MASK_WORDS = {
    Masks.EXACT: "exact outlines",
    Masks.DISTURBED: "outlines disturbed by 1.5 px",
    Masks.PERCEIVED: "outlines found by a network",
}
_TRUTHS = (LengthDefinition.CENTRELINE, LengthDefinition.THREAD)
_GROUPED_CAPTURES = 10  # minimum number of captures for groups

_GLANCE = (
    *("part", "outlines", "measurements", "fruit", "M6 centreline MAPE (%)", "worst (%):.1"),
    *("measured (%):.1", "M6 thread MAPE (%)"),
    *("M5 against centreline, MAPE (%)", "M5 against thread, MAPE (%)"),
)


def benchmark_tables(readings: pd.DataFrame) -> list[ReportTable]:
    """Return all tables of a benchmark: beside the paper, at a glance, then by suite and masks.

    Parameters
    ----------
    readings : DataFrame
        Readings from `run_benchmark`.

    Raises
    ------
    CucumberVisionError
        If there are no readings.
    """
    if readings.empty:
        raise CucumberVisionError("nothing to report", remedy="measure at least one fruit first")
    paper = paper_table(readings)
    tables = [*([paper] if paper else ()), glance_table(readings)]
    for suite, masks, part in _parts(readings):
        part_tables = [accuracy_table(part, truth) for truth in truths_of(part)]
        if part["case"].nunique() >= _GROUPED_CAPTURES:
            for truth in _TRUTHS[:1] if suite is Suite.STRESS else _TRUTHS:
                part_tables += group_tables(comparable_readings(part, truth), truth)
        where = f"{_SUITES[suite]}, {_MASK_WORDS[masks]}"
        tables += [replace(table, title=f"{where}: {table.title}") for table in part_tables]
    return tables


def glance_table(readings: pd.DataFrame) -> ReportTable:
    """Return a summary of M6 and the paper's M5 by suite and kind of masks.

    Parameters
    ----------
    readings : DataFrame
        See `benchmark_tables`.
    """
    rows: list[tuple[Cell, ...]] = []
    for suite, masks, part in _parts(readings):
        scored = {truth: comparable_readings(part, truth) for truth in _TRUTHS}
        mape = {
            (truth, str(method)): float(percent.mean())
            for truth, frame in scored.items()
            for method, percent in frame.groupby("method", observed=True)["error_percent"]
        }
        read = scored[LengthDefinition.CENTRELINE].query("method == 'M6'")
        tube = score(read["length_m"], read["true_m"]) if len(read) else None
        rows.append(
            (
                _SUITES[suite],
                _MASK_WORDS[masks],
                part["case"].nunique(),
                part["fruit"].nunique(),
                tube.mape_percent if tube else None,
                tube.worst_percent if tube else None,
                100 * tube.measured if tube else None,
                mape.get((LengthDefinition.THREAD, "M6 thread")),
                mape.get((LengthDefinition.CENTRELINE, "M5")),
                mape.get((LengthDefinition.THREAD, "M5")),
            )
        )
    comment = "Mean error in percent of the true length; a fruit not measured counts as 100 %."
    return ReportTable.of("At a glance", _GLANCE, rows, comment)


def _parts(readings: pd.DataFrame) -> list[tuple[Suite, Masks, pd.DataFrame]]:
    """Return the readings by suite and kind of masks, in the order of the report."""
    parts = [
        (suite, masks, readings[(readings["suite"] == suite) & (readings["masks"] == masks)])
        for suite in Suite
        for masks in Masks
    ]
    return [part for part in parts if len(part[2])]


_PUBLISHED: dict[str, tuple[Cell, ...]] = {
    "M1": (1.63, 2.26, 9.68, None, 1.31, 0.89),
    "M2": (0.83, 1.12, 5.31, "3.97 to 6.60", 0.59, 0.95),
    "M3": (0.96, 1.02, 5.82, "4.87 to 7.49", 0.72, 0.97),
    "M4": (0.85, 1.01, 5.51, "4.12 to 7.01", 0.55, 0.97),
    "M5": (0.58, 0.61, 4.13, None, 0.40, 0.98),
}
"""Accuracy reported in the paper (48 captures of 7 cucumbers, against the thread): MAE and RMSE in
cm, MAPE and its bootstrap 95 % interval by capture, median absolute error in cm (from the caption
of its error plot), R². Intervals are omitted where the paper contradicts itself."""


def paper_table(readings: pd.DataFrame) -> ReportTable | None:
    """Return the paper's results next to those of the same protocol, against the thread.

    Returns
    -------
    ReportTable or None
        None without readings of the paper's suite.
    """
    protocol = readings[readings["suite"] == Suite.PAPER]
    if protocol.empty:
        return None
    scored = comparable_readings(protocol, LengthDefinition.THREAD)
    heads = ["method", "whose", "MAE (cm)", "RMSE (cm)", "MAPE (%)", "95 % by capture (%)"]
    heads += ["median error (cm)", "R²", "measured (%)", "median error (%)"]
    rows: list[tuple[Cell, ...]] = []
    for method in (*PAPER_METHODS, "M6 thread"):
        if method in _PUBLISHED:
            rows.append((method, "the paper", *_PUBLISHED[method], None, None))
        for masks in Masks:
            rows += _here(scored[(scored["masks"] == masks) & (scored["method"] == method)], masks)
    comment = (
        "'The paper': what it prints for 48 captures of seven cucumbers of its own. 'Here': the "
        "same protocol, simulated, against the thread as in the paper. The paper's captures are "
        "not published, so that the two stand side by side and cannot be compared fruit by "
        "fruit. Its intervals for M1 and M5 are left out: one does not contain its own mean, the "
        "other is printed in two ways."
    )
    title = "The paper's figures, on its own captures, beside this program's"
    return ReportTable.of(title, heads, rows, comment)


def _here(read: pd.DataFrame, masks: Masks) -> list[tuple[Cell, ...]]:
    if read.empty:
        return []
    scores = score(read["length_m"], read["true_m"])
    errors = (
        scores.mae_cm,
        scores.rmse_cm,
        scores.mape_percent,
        span_text(estimate(read["error_percent"], resamples=10_000)),
        float(read["error_cm"].median()),
        scores.r2,
        100 * scores.measured,
        scores.median_percent,
    )
    return [(str(read["method"].iloc[0]), f"here, {masks} outlines", *errors)]


@contextmanager
def writing_report(out: Path) -> Iterator[None]:
    """Create an output folder, and convert write errors in the block to CucumberVisionError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise CucumberVisionError(
            f"cannot be written ({error.strerror})", source=out, remedy="choose another --out"
        ) from error


def write_tables(path: Path, about: Mapping[str, object], tables: Sequence[ReportTable]) -> Path:
    """Write a report's tables with unrounded numbers as JSON.

    Parameters
    ----------
    path : Path
        The file; its folder is created if missing.
    about : mapping of str to object
        Provenance, as JSON values.
    tables : sequence of ReportTable
        The tables.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    CucumberVisionError
        If it cannot be written.
    """
    with writing_report(path.parent):
        write_json(path, {**about, "tables": [table.as_json() for table in tables]})
    return path
