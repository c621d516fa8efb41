"""The benchmark's tables: accuracy of every method, the paper's figures, every suite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cucumbervision.accuracy.statistics import Cell, Estimate, ReportTable, estimate, score
from cucumbervision.errors import CucumberVisionError, wrap_os_errors
from cucumbervision.files import write_json
from cucumbervision.methods.result import LengthDefinition
from cucumbervision.methods.table import AVAILABLE, TableMethod
from cucumbervision_lab.evaluate.cases import Suite
from cucumbervision_lab.evaluate.measure_case import Masks

_TRUTHS = (LengthDefinition.CENTRELINE, LengthDefinition.THREAD, LengthDefinition.CHORD)
"""Definitions of length, in the order of all reports."""

DESCRIPTIONS = {
    **{name: TableMethod.of(name).title for name in AVAILABLE},
    "M6": "swept tube, centreline",
    "M6 thread": "swept tube, thread",
    "M6 chord": "swept tube, chord",
    "skan": "longest skeleton path",
    "selector best": "what this program reports",
    "selector paper": "what the paper's selector reports",
}
"""Descriptions of methods, in the order of all tables; other methods come last."""

PAPER_METHODS = tuple(name for name in AVAILABLE if TableMethod.of(name).is_paper)
_COUNT_OF_RESAMPLES = 10_000
_RESAMPLED_VALUES = 5_000_000  # limits the memory of a bootstrap


def comparable_readings(readings: pd.DataFrame, truth: LengthDefinition) -> pd.DataFrame:
    """Return the readings that are comparable with one definition of length, with their errors.

    M1 to M5 and other tools are compared with every definition, because they do not state theirs.
    The thread and chord of M6 are compared with the same definition only, its centreline also with
    the thread, as in the paper.

    Parameters
    ----------
    readings : DataFrame
        Readings from `readings_frame`.
    truth : LengthDefinition
        Definition of length.

    Returns
    -------
    DataFrame
        Readings with `true_m` (metres), `error_cm` and `error_percent` (absolute; a missing length
        counts as 0), and `method` as an ordered category.

    Examples
    --------
    >>> frame = pd.DataFrame({"method": ["M6", "M1", "M6 thread"], "length_m": [0.21, 0.1, 0.22]})
    >>> frame[["centreline_m", "thread_m", "chord_m"]] = 0.2, 0.22, np.nan
    >>> comparable_readings(frame, LengthDefinition.THREAD).method.tolist()
    ['M6', 'M1', 'M6 thread']
    >>> scored = comparable_readings(frame, LengthDefinition.CENTRELINE)
    >>> scored.set_index("method").error_percent.round(1).to_dict()
    {'M6': 5.0, 'M1': 50.0}
    >>> len(comparable_readings(frame, LengthDefinition.CHORD))
    0
    """
    method, true_m = readings["method"], readings[f"{truth}_m"]
    suffixes = tuple(
        f" {kind}" for kind in (LengthDefinition.THREAD, LengthDefinition.CHORD) if kind != truth
    )
    fits = true_m.notna() & ~method.str.endswith(suffixes)
    if truth is LengthDefinition.CHORD:
        fits &= ~method.isin(["M6", "selector best"])
    scored = readings[fits].copy()
    scored["true_m"] = true_m[fits]
    scored["error_cm"] = 100 * (scored["length_m"].fillna(0) - scored["true_m"]).abs()
    scored["error_percent"] = scored["error_cm"] / scored["true_m"]
    order = {name: k for k, name in enumerate(DESCRIPTIONS)}
    methods = sorted(
        scored["method"].unique(), key=lambda name: (order.get(name, len(order)), name)
    )
    scored["method"] = pd.Categorical(scored["method"], methods, ordered=True)
    return scored


def truths_of(readings: pd.DataFrame) -> list[LengthDefinition]:
    """Return the definitions for which any true length is known."""
    return [truth for truth in _TRUTHS if readings[f"{truth}_m"].notna().any()]


def shown_methods(scored: pd.DataFrame, truth: LengthDefinition) -> list[str]:
    """Return the methods to list, with M6 by the matching definition and without selectors."""
    methods = list(scored["method"].cat.categories)
    doubled = "M6" if f"M6 {truth}" in methods else None
    return [m for m in methods if m != doubled and not m.startswith("selector")]


_ACCURACY_HEADINGS = {
    "method": "method",
    "count": "captures",
    "fruit": "fruit",
    "measured_percent": "measured (%):.1",
    "mae_cm": "MAE (cm)",
    "rmse_cm": "RMSE (cm)",
    "mape_percent": "MAPE (%)",
    "by_capture": "95 % by capture (%)",
    "by_fruit": "95 % by fruit (%)",
    "median_percent": "median error (%)",
    "worst_percent": "worst error (%):.1",
    "r2": "R²:.3",
    "pearson_r": "Pearson r:.4",
    "bias_percent": "bias (%):+.2",
    "words": "what it is",
}


def accuracy_table(readings: pd.DataFrame, truth: LengthDefinition) -> ReportTable:
    """Return the accuracy of every method.

    Parameters
    ----------
    readings : DataFrame
        Readings of one suite and one kind of masks.
    truth : LengthDefinition
        Definition of length.
    """
    rows: list[dict[str, Any]] = []
    for method, part in comparable_readings(readings, truth).groupby("method", observed=True):
        metrics, percent = score(part["length_m"], part["true_m"]), part["error_percent"]
        resamples = int(np.clip(_RESAMPLED_VALUES / len(part), 1000, _COUNT_OF_RESAMPLES))
        rows.append(
            {
                **vars(metrics),
                "method": str(method),
                "fruit": part["fruit"].nunique(),
                "measured_percent": 100 * metrics.measured,
                "by_capture": span_text(estimate(percent, resamples=resamples)),
                "by_fruit": span_text(estimate(percent, part["fruit"], resamples=resamples)),
                "words": DESCRIPTIONS.get(str(method), ""),
            }
        )
    comment = (
        f"Errors against the true {truth}. A fruit that a method did not measure counts as 100 % "
        "error. Captures of one fruit resemble each other: use the interval by fruit."
    )
    return ReportTable.of_records(
        f"Accuracy against the {truth}", _ACCURACY_HEADINGS, rows, comment
    )


_GROUP_EDGES_NOTE = "The lower bound belongs to the group, the upper to the next."
_EPSILON, _STRAIGHT_CM = 1e-9, 1e6
_FACTORS: tuple[tuple[str, str, tuple[float, ...], tuple[str, ...], str], ...] = (
    (
        *("true_cm", "true length (cm)", (0, 10, 18, np.inf)),
        ("small: below 10", "medium: 10 to 18", "large: 18 and more"),
        "",
    ),
    (
        *("tilt", "tilt (°)", (0, 15, 30, 45, 60 + _EPSILON, np.inf)),
        ("0 to 15", "15 to 30", "30 to 45", "45 to 60", "above 60"),
        "Angle of the fruit's chord out of the picture plane. ",
    ),
    (
        *("distance_cm", "distance (cm)", (0, 50, 70, 90, np.inf)),
        ("below 50", "50 to 70", "70 to 90", "90 and more"),
        "From the camera to the fruit's middle. ",
    ),
    (
        *("radius_cm", "radius of the bend (cm)", (0, 15, 30, _STRAIGHT_CM, np.inf)),
        ("below 15", "15 to 30", "30 and more", "straight"),
        "The smaller, the more bent. ",
    ),
    (
        *("hidden", "hidden share of the fruit (%)"),
        (-_EPSILON, _EPSILON, 20.0, 40.0, 60 + _EPSILON, np.inf),
        ("0", "above 0 to 20", "20 to 40", "40 to 60", "above 60"),
        "",
    ),
)


def group_tables(scored: pd.DataFrame, truth: LengthDefinition) -> list[ReportTable]:
    """Return, for each factor with at least two groups, the MAPE of each method by group.

    Also median, worst error and yield of M6. Selectors are omitted, because the lengths they choose
    are already included.

    Parameters
    ----------
    scored : DataFrame
        Readings from `comparable_readings`.
    truth : LengthDefinition
        Definition of length.
    """
    values = pd.DataFrame(
        {
            "true_cm": 100 * scored["true_m"],
            "tilt": scored["tilt_deg"].abs(),
            "distance_cm": 100 * scored["distance_m"],
            "radius_cm": (100 * scored["bend_radius_m"]).fillna(_STRAIGHT_CM),
            "hidden": 100 * scored["hidden_share"],
        }
    )
    factors = []
    for name, head, edges, labels, comment in _FACTORS:
        groups = pd.cut(values[name], list(edges), right=False, labels=list(labels))
        if name == "radius_cm":  # the straight ones first
            groups = groups.cat.reorder_categories(list(labels)[::-1], ordered=True)
        factors.append((head, groups, f"{comment}{_GROUP_EDGES_NOTE}"))
    names = list(scored["condition"].unique())
    factors.append(("condition", pd.Categorical(scored["condition"], names), ""))
    if "m6_flags" in scored:
        flagged = scored["m6_flags"].map(lambda flags: bool(flags) or not isinstance(flags, list))
        words = flagged.map({False: "none", True: "some, or not measured"})
        factors.append(("M6's flags", pd.Categorical(words, ["none", "some, or not measured"]), ""))
    return [
        _group_table(scored.assign(group=groups), head, comment, truth)
        for head, groups, comment in factors
        if pd.Series(groups).nunique() > 1
    ]


def _group_table(
    scored: pd.DataFrame, head: str, comment: str, truth: LengthDefinition
) -> ReportTable:
    methods = shown_methods(scored, truth)
    m6_method = f"M6 {truth}" if f"M6 {truth}" in methods else "M6"
    heads = [head, "captures", "fruit", *(f"{method} MAPE (%)" for method in methods)]
    if m6_method in methods:
        words = ("median (%)", "worst (%):.1", "measured (%):.1")
        heads += [f"{m6_method} {word}" for word in words]
    rows: list[tuple[Cell, ...]] = []
    for label, inside in scored.groupby("group", observed=True):
        mape = inside.groupby("method", observed=True)["error_percent"].mean()
        row: list[Cell] = [str(label), inside["case"].nunique(), inside["fruit"].nunique()]
        row += [float(mape[m]) if m in mape else None for m in methods]
        if m6_method in methods:
            read = inside[inside["method"] == m6_method]
            percent = read["error_percent"]
            measured = 100 * float(read["length_m"].notna().mean())
            worst = [float(percent.median()), float(percent.max()), measured]
            row += worst if len(read) else [None] * 3
        rows.append(tuple(row))
    return ReportTable.of(f"By {head}, against the {truth}", heads, rows, comment)


def span_text(span: Estimate, decimals: int = 2, scale: float = 1.0) -> str | None:
    """Format the interval of an estimate as text; None without an interval.

    Examples
    --------
    >>> span_text(Estimate(value=1.5, low=1.0, high=2.345, count=9, groups=9))
    '1.00 to 2.35'
    """
    if np.isnan(span.low):
        return None
    return f"{scale * span.low:.{decimals}f} to {scale * span.high:.{decimals}f}"


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
_GROUPED_TRUTHS = (LengthDefinition.CENTRELINE, LengthDefinition.THREAD)
_GROUPED_CAPTURES = 10  # minimum number of captures for groups


def benchmark_tables(readings: pd.DataFrame) -> list[ReportTable]:
    """Return all tables of a benchmark: beside the paper, then by suite and masks.

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
    tables = [paper] if paper else []
    for suite, masks, part in _parts(readings):
        part_tables = [accuracy_table(part, truth) for truth in truths_of(part)]
        if part["case"].nunique() >= _GROUPED_CAPTURES:
            for truth in _GROUPED_TRUTHS[:1] if suite is Suite.STRESS else _GROUPED_TRUTHS:
                part_tables += group_tables(comparable_readings(part, truth), truth)
        where = f"{_SUITES[suite]}, {_MASK_WORDS[masks]}"
        tables += [replace(table, title=f"{where}: {table.title}") for table in part_tables]
    return tables


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
    with wrap_os_errors("cannot be written", path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {**about, "tables": [table.as_json() for table in tables]})
    return path
