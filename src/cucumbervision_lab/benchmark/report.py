"""The benchmark's report: the paper's figures beside ours, then every suite and kind of masks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from cucumbervision.accuracy.statistics import score
from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark import page, plots
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.length_tables import (
    accuracy_table,
    against,
    factors_of,
    group_table,
    truths_of,
)
from cucumbervision_lab.benchmark.page import Plot, Section
from cucumbervision_lab.benchmark.paper import NOTES, paper_table
from cucumbervision_lab.benchmark.records import Masks

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_SUITES = {
    Suite.PAPER: (
        "The paper's protocol",
        "The paper's plan, simulated: 48 captures of seven cucumbers in three sizes, every method "
        "on the same captures. The camera and its noise are simulated, so the true length is known "
        "exactly.",
    ),
    Suite.VALIDATION: (
        "The five validation fruit",
        "Five more fruit with the thread lengths of the paper's validation table, simulated.",
    ),
    Suite.STRESS: (
        "The stress set",
        "Simulated fruit beyond the paper: tilted, bent, partly hidden, near and far, in sun and "
        "with wet leaves. Each is another fruit.",
    ),
}
_MASK_WORDS = {
    Masks.EXACT: "exact outlines",
    Masks.DISTURBED: "outlines disturbed by 1.5 px",
    Masks.PERCEIVED: "outlines found by a network",
}
_TRUTHS = (LengthDefinition.CENTRELINE, LengthDefinition.THREAD)


_GROUPED_CAPTURES = 10  # fewer are neither plotted nor grouped
_GLOSSARY = (
    (
        "centreline",
        "Length of the fruit's central axis, from the stem's attachment to the blossom end: what a "
        "tape reads, and what this program reports.",
    ),
    (
        "thread",
        "Length of the outer side of the bend, from end to end: the paper's ground truth. It is 2 "
        "to 6 % more than the centreline of a usual fruit, and the same for a straight one.",
    ),
    ("chord", "Straight from end to end, as a caliper measures."),
    (
        "M1 to M5",
        "The paper's five methods, rebuilt as it describes them: scan line, principal axis of the "
        "box, principal axis of the mask, keypoints, spline along the mask.",
    ),
    (
        "M6",
        "This program's own method: a tube with round ends, fitted to depth and outline together. "
        "It gives all three lengths ('M6' is its centreline).",
    ),
    (
        "skan, PlantCV, rectangle",
        "Other people's tools on the same mask and depth: the longest path and the longest segment "
        "of the mask's skeleton, lifted into space, and the long side of its smallest rectangle.",
    ),
    ("MAE, RMSE", "Mean absolute error, and root mean square error, which weighs large ones more."),
    ("MAPE", "Mean absolute error in percent of the true length."),
    ("bias", "Mean signed error of the fruit measured; negative means read too short."),
    ("R², Pearson r", "How well lengths follow the truth: 1 is perfect. R² also counts a bias."),
    (
        "95 % by capture, by fruit",
        "Range of the MAPE if captures, or whole fruit, are drawn again at random (bootstrap).",
    ),
)


_GLANCE = (
    *("part", "outlines", "measurements", "fruit", "M6 centreline MAPE (%)", "worst (%):.1"),
    *("measured (%):.1", "M6 thread MAPE (%)"),
    *("M5 against centreline, MAPE (%)", "M5 against thread, MAPE (%)"),
)


def write_benchmark_report(
    readings: pd.DataFrame,
    out: Path,
    *,
    provenance: Mapping[str, object] | None = None,
) -> Path:
    """Write `report.html` and `benchmark.json`.

    Parameters
    ----------
    readings : DataFrame
        Of any suites and masks, as `run_benchmark` gives them.
    out : Path
        The folder, made if it is missing.
    provenance : mapping of str to object, optional
        How the numbers came about: seeds, versions, machine, duration.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    CucumberVisionError
        If there are no readings.
    MissingExtraError
        If matplotlib or Jinja2 is not installed.
    """
    if readings.empty:
        raise CucumberVisionError(
            "there is nothing to report", source=out, remedy="measure at least one fruit first"
        )
    beside = paper_table(readings)
    notes = tuple(NOTES["paper"].split("\n\n"))
    return page.write_report(
        out,
        "CucumberVision benchmark",
        [
            *([Section("Beside the paper", notes, (beside,))] if beside else ()),
            *(_suite_section(part, suite, masks) for suite, masks, part in _parts(readings)),
        ],
        notes=NOTES["summary"].split("\n\n"),
        glance=glance_table(readings),
        provenance=provenance,
        glossary=_GLOSSARY,
    )


def glance_table(readings: pd.DataFrame) -> Table:
    """Sum every suite and kind of masks up: M6 beside the paper's M5.

    Parameters
    ----------
    readings : DataFrame
        As for `write_benchmark_report`.
    """
    rows: list[tuple[Cell, ...]] = []
    for suite, masks, part in _parts(readings):
        scored = {truth: against(part, truth) for truth in _TRUTHS}
        mape = {
            (truth, str(method)): float(percent.mean())
            for truth, frame in scored.items()
            for method, percent in frame.groupby("method", observed=True)["error_percent"]
        }
        read = scored[LengthDefinition.CENTRELINE].query("method == 'M6'")
        tube = score(read["length_m"], read["true_m"]) if len(read) else None
        rows.append(
            (
                _SUITES[suite][0],
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
    return Table.of("At a glance", _GLANCE, rows, comment)


def _parts(readings: pd.DataFrame) -> list[tuple[Suite, Masks, pd.DataFrame]]:
    """Return the readings of each suite and kind of masks that has any, in a report's order."""
    parts = [
        (suite, masks, readings[(readings["suite"] == suite) & (readings["masks"] == masks)])
        for suite in Suite
        for masks in Masks
    ]
    return [part for part in parts if len(part[2])]


def _suite_section(readings: pd.DataFrame, suite: Suite, masks: Masks) -> Section:
    """Return the section over one suite and kind of masks."""
    captures, fruit = readings["case"].nunique(), readings["fruit"].nunique()
    (title, words), outlines = _SUITES[suite], _MASK_WORDS[masks]
    entries: list[Table | Plot] = [accuracy_table(readings, truth) for truth in truths_of(readings)]
    if captures >= _GROUPED_CAPTURES:
        for truth in _TRUTHS[:1] if suite is Suite.STRESS else _TRUTHS:
            entries += _plots(readings, truth)
            scored = against(readings, truth)
            factors = factors_of(scored, scored["true_m"])
            entries += [group_table(scored, factor, truth) for factor in factors]
    intro = (words, f"{captures} measurements of {fruit} fruit, with {outlines}.")
    return Section(f"{title}, {outlines}", intro, tuple(entries))


def _plots(readings: pd.DataFrame, truth: LengthDefinition) -> list[Plot]:
    measured = f"Measured against true {truth}; on the line, both are the same."
    spread = (
        f"Absolute errors against the {truth}: the box holds the middle half, the whiskers "
        "90 of 100, the black bar is the median, each dot a capture."
    )
    return [
        Plot(measured, plots.predicted_against_truth(readings, truth)),
        Plot(spread, plots.error_spread(readings, truth)),
    ]
