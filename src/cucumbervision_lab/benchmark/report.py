"""Report of the benchmark: comparison with the paper, then every suite."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from cucumbervision.accuracy.statistics import estimate, score
from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark import page
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.length_tables import (
    PAPER_METHODS,
    accuracy_table,
    comparable_readings,
    factors_of,
    group_table,
    span_text,
    truths_of,
)
from cucumbervision_lab.benchmark.page import Plot, Section
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


_GROUPED_CAPTURES = 10  # minimum number of captures for plots and groups
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
        "skan, PlantCV",
        "Other people's tools on the same mask and depth: the longest path and the longest segment "
        "of the mask's skeleton, lifted into space.",
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
        Readings from `run_benchmark`.
    out : Path
        Output folder; created if missing.
    provenance : mapping of str to object, optional
        Seeds, versions, machine and duration.

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
            "nothing to report", source=out, remedy="measure at least one fruit first"
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
    """Return a summary of M6 and the paper's M5 by suite and kind of masks.

    Parameters
    ----------
    readings : DataFrame
        See `write_benchmark_report`.
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
    """Return the readings by suite and kind of masks, in the order of the report."""
    parts = [
        (suite, masks, readings[(readings["suite"] == suite) & (readings["masks"] == masks)])
        for suite in Suite
        for masks in Masks
    ]
    return [part for part in parts if len(part[2])]


def _suite_section(readings: pd.DataFrame, suite: Suite, masks: Masks) -> Section:
    """Return the section of one suite and kind of masks."""
    captures, fruit = readings["case"].nunique(), readings["fruit"].nunique()
    (title, words), outlines = _SUITES[suite], _MASK_WORDS[masks]
    entries: list[Table | Plot] = [accuracy_table(readings, truth) for truth in truths_of(readings)]
    if captures >= _GROUPED_CAPTURES:
        for truth in _TRUTHS[:1] if suite is Suite.STRESS else _TRUTHS:
            caption = f"Measured against true {truth}; on the line, both are the same."
            entries.append(Plot(caption, page.predicted_against_truth(readings, truth)))
            scored = comparable_readings(readings, truth)
            factors = factors_of(scored, scored["true_m"])
            entries += [group_table(scored, factor, truth) for factor in factors]
    intro = (words, f"{captures} measurements of {fruit} fruit, with {outlines}.")
    return Section(f"{title}, {outlines}", intro, tuple(entries))


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


NOTES = {
    "summary": (
        "Every capture is simulated: bodies whose lengths are known exactly, seen by a model of a "
        "D435 whose noise, holes and edges were matched to real frames. Real fruit have ridges, "
        "stalks and withered blossoms that these lack. A fruit that a method does not measure "
        "counts as 100 % error, so a method gains nothing by refusing.\n\n"
        "'Exact' masks are the fruit's own pixels; 'disturbed' ones have their outline moved by a "
        "smooth field of 1.5 px RMS. For 'perceived' ones nothing is given: the detector finds the "
        "fruit, the pose network places its keypoints and MobileSAM draws it; a fruit that is not "
        "found counts as not measured. The depth scale is exact in all tables, as after `calibrate "
        "--grid`; an uncalibrated camera adds its own."
    ),
    "paper": (
        "The paper's figures were read on its own captures of seven real cucumbers against the "
        "outer side of the bend; these on simulated captures of seven fruit whose outer sides are "
        "as long. They stand side by side; they do not measure the same captures.\n\n"
        "Reproduced: M2, M3 and the medians of M4 and M5. M5's mean is not: it contains outliers "
        "on short fruit beyond 0.7 m. There the outermost two or three of its 25 bins hold mostly "
        "mixed readings of fruit and background, up to 3 cm behind the fruit and still within the "
        "gate of 3.5 cm, so the spline bends away from the camera at both ends. M4 fails there "
        "for the same reason: the 5x5 window at an endpoint holds mixed readings. M1 is not "
        "reproduced: its outer lines leave a fruit that does not fill its box. The paper's "
        "validation table gives M5 an error of exactly zero on five fruit, and its interval for "
        "M1 does not contain its own mean; neither is reproduced."
    ),
}
"""Notes on the interpretation of the benchmark."""


def paper_table(readings: pd.DataFrame) -> Table | None:
    """Return the paper's results next to those of the same protocol, against the thread.

    Returns
    -------
    Table or None
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
    return Table.of(title, heads, rows, comment)


def _here(read: pd.DataFrame, masks: Masks) -> list[tuple[Cell, ...]]:
    if read.empty:
        return []
    found = score(read["length_m"], read["true_m"])
    errors = (
        found.mae_cm,
        found.rmse_cm,
        found.mape_percent,
        span_text(estimate(read["error_percent"], resamples=10_000)),
        float(read["error_cm"].median()),
        found.r2,
        100 * found.measured,
        found.median_percent,
    )
    return [(str(read["method"].iloc[0]), f"here, {masks} outlines", *errors)]
