"""The benchmark's report: every suite and kind of masks, the intervals' coverage, experiments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from cucumbervision.accuracy.statistics import binomial_interval, score
from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.paper import NOTES, paper_section
from cucumbervision_lab.report import length_report, page
from cucumbervision_lab.report.length_tables import (
    Factor,
    against,
    factors_of,
    shown_methods,
)
from cucumbervision_lab.report.page import Plot, Section
from cucumbervision_lab.report.plots import as_png, method_style, new_figure
from cucumbervision_lab.report.records import Masks

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike

_SUITE_WORDS = {
    Suite.PAPER: "The paper's protocol",
    Suite.VALIDATION: "The five validation fruit",
    Suite.STRESS: "The stress set",
}
_MASK_WORDS = {
    Masks.EXACT: "exact outlines",
    Masks.DISTURBED: "outlines disturbed by 1.5 px",
    Masks.PERCEIVED: "outlines found by a network",
}
_SUITE_INTRO = {
    Suite.PAPER: (
        "The paper's plan, simulated: 48 captures of seven cucumbers in three sizes, every method "
        "on the same captures. The camera and its noise are simulated, so the true length is known "
        "exactly."
    ),
    Suite.VALIDATION: (
        "Five more fruit with the thread lengths of the paper's validation table, simulated."
    ),
    Suite.STRESS: (
        "Simulated fruit beyond the paper: tilted, bent, partly hidden, near and far, in sun and "
        "with wet leaves. Each is another fruit."
    ),
}
_COVERED = {LengthDefinition.CENTRELINE: "M6", LengthDefinition.THREAD: "M6 thread"}
"""The readings whose intervals are judged."""

_GLOSSARY = (
    *length_report.GLOSSARY,
    (
        "skan, PlantCV, rectangle",
        "Other people's tools on the same mask and depth: the longest path and the longest segment "
        "of the mask's skeleton, lifted into space, and the long side of its smallest rectangle.",
    ),
    (
        "oracle",
        "Not a method: it knows the true tube and errs only by what the outline says about the two "
        "ends. Nobody can be expected to do better on the same masks.",
    ),
)
_LARGE_GROUP = 400  # fruit from which on coverage is compared with fixed bounds
_LARGE_GROUP_SHARE = (0.87, 0.93)  # for a 90 % interval; moved along with another level
TILT_EDGES_DEG = np.arange(0, 61, 7.5)
_HIDDEN_EDGES_PERCENT = (0, 0.01, 10, 20, 30, 40, 50, 60)
_SMALLEST_PERCENT = 0.01  # what a logarithmic axis starts at


_GLANCE = (
    *("part", "outlines", "measurements", "fruit", "M6 centreline MAPE (%)", "worst (%):.1"),
    *("measured (%):.1", "oracle MAPE (%)", "M6 thread MAPE (%)"),
    *("M5 against centreline, MAPE (%)", "M5 against thread, MAPE (%)"),
)


def write_benchmark_report(
    readings: pd.DataFrame,
    out: Path,
    *,
    experiments: Mapping[str, Table] | None = None,
    provenance: Mapping[str, object] | None = None,
    level: float = 0.9,
) -> Path:
    """Write `report.html` and `benchmark.json`.

    Parameters
    ----------
    readings : DataFrame
        Of any suites and masks, as `run_benchmark` gives them.
    out : Path
        The folder, made if it is missing.
    experiments : mapping of str to Table, optional
        Further tables.
    provenance : mapping of str to object, optional
        How the numbers came about: seeds, versions, machine, duration.
    level : float
        Level that the intervals state.

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
    parts = parts_of(readings)
    beside = paper_section(readings)
    sections = [beside] if beside else []
    sections += [_suite_section(part, suite, masks, level) for suite, masks, part in parts]
    if experiments:
        sections.append(Section("Experiments", (), tuple(experiments.values())))
    return page.write_report(
        out,
        "CucumberVision benchmark",
        _glance_table(parts),
        sections,
        notes=[("", NOTES["summary"])],
        provenance=provenance,
        glossary=_GLOSSARY,
        numbers={
            "notes": NOTES,
            "interval_level": level,
            "records": sum(part["case"].nunique() for _, _, part in parts),
        },
    )


def _glance_table(parts: Iterable[tuple[Suite, Masks, pd.DataFrame]]) -> Table:
    """Sum parts up: M6 beside the oracle and the paper's M5.

    Parameters
    ----------
    parts : iterable of (Suite, Masks, DataFrame)
        As `parts_of` gives them.
    """
    rows: list[tuple[Cell, ...]] = []
    for suite, masks, readings in parts:
        scored = {
            truth: against(readings, truth)
            for truth in (LengthDefinition.CENTRELINE, LengthDefinition.THREAD)
        }
        mape = {
            (truth, str(method)): float(percent.mean())
            for truth, frame in scored.items()
            for method, percent in frame.groupby("method", observed=True)["error_percent"]
        }
        read = scored[LengthDefinition.CENTRELINE].query("method == 'M6'")
        tube = score(read["length_m"], read["true_m"]) if len(read) else None
        rows.append(
            (
                _SUITE_WORDS[suite],
                _MASK_WORDS[masks],
                readings["case"].nunique(),
                readings["fruit"].nunique(),
                tube.mape_percent if tube else None,
                tube.worst_percent if tube else None,
                100 * tube.measured if tube else None,
                mape.get((LengthDefinition.CENTRELINE, "oracle")),
                mape.get((LengthDefinition.THREAD, "M6 thread")),
                mape.get((LengthDefinition.CENTRELINE, "M5")),
                mape.get((LengthDefinition.THREAD, "M5")),
            )
        )
    comment = "Mean error in percent of the true length; a fruit not measured counts as 100 %."
    return Table.of("At a glance", _GLANCE, rows, comment)


def parts_of(readings: pd.DataFrame) -> list[tuple[Suite, Masks, pd.DataFrame]]:
    """Return the readings of each suite and kind of masks that has any, in a report's order."""
    parts = [
        (suite, masks, readings[(readings["suite"] == suite) & (readings["masks"] == masks)])
        for suite in Suite
        for masks in Masks
    ]
    return [part for part in parts if len(part[2])]


def _suite_section(readings: pd.DataFrame, suite: Suite, masks: Masks, level: float) -> Section:
    """Return the section over one suite and kind of masks.

    Parameters
    ----------
    readings : DataFrame
        Of that suite and those masks.
    suite : Suite
        Which suite.
    masks : Masks
        Which masks.
    level : float
        Level that the intervals state.
    """
    captures, fruit = readings["case"].nunique(), readings["fruit"].nunique()
    words = _MASK_WORDS[masks]
    intro = (_SUITE_INTRO[suite], f"{captures} measurements of {fruit} fruit, with {words}.")
    truths = length_report.main_truths(readings)
    truths = truths[:1] if suite is Suite.STRESS else truths
    entries = length_report.accuracy_entries(readings)
    if suite is Suite.VALIDATION:
        entries += length_report.fruit_entries(readings, truths)
    entries += length_report.plot_entries(readings, truths)
    if captures >= length_report.GROUPED_CAPTURES:
        if suite is Suite.STRESS:
            entries += _stress_plots(readings, truths[0])
        entries += length_report.group_entries(readings, truths)
        entries += _coverage_entries(readings, level)
    return Section(f"{_SUITE_WORDS[suite]}, {words}", intro, tuple(entries))


def _stress_plots(readings: pd.DataFrame, truth: LengthDefinition) -> list[Table | Plot]:
    scored = against(readings, truth)
    tilt, hidden = scored["tilt_deg"].abs(), 100 * scored["hidden_share"]
    by_tilt = error_by_value_plot(scored, truth, tilt, TILT_EDGES_DEG, "tilt of the fruit (°)")
    by_hidden = error_by_value_plot(
        scored, truth, hidden, _HIDDEN_EDGES_PERCENT, "hidden share of the fruit (%)"
    )
    caption = "Mean error by the fruit's tilt; each step up the scale is ten times the error."
    return [
        Plot(caption, by_tilt),
        Plot("Mean error by how much of the fruit is hidden; the same scale.", by_hidden),
    ]


def _coverage_entries(readings: pd.DataFrame, level: float) -> list[Table | Plot]:
    entries: list[Table | Plot] = []
    for truth in _COVERED:
        groups = coverage_by_group(readings, truth, level)
        if groups.empty:
            continue
        caption = (
            f"How often the {100 * level:.0f} % interval holds the true {truth}, by group; the bar "
            "is what chance allows (95 %). Blue: as stated. Orange diamonds: not."
        )
        title = f"How often the interval holds the true {truth}"
        entries.append(coverage_table(groups, level, title))
        entries.append(Plot(caption, coverage_plot(groups, level)))
    return entries


def coverage_by_group(
    readings: pd.DataFrame, truth: LengthDefinition, level: float = 0.9
) -> pd.DataFrame:
    """Count by group how often M6's interval holds the truth.

    Parameters
    ----------
    readings : DataFrame
        Rows with `low_m` and `high_m` count.
    truth : LengthDefinition
        Which length.
    level : float
        What the interval claims.

    Returns
    -------
    DataFrame
        `factor`, `group`; `captures` and `fruit` with an interval; `hits`, how many intervals
        hold the truth; `low`, `high`, the exact binomial 95 % interval of the share of hits;
        `width_percent`, the mean width in percent of the length; and `as_stated`: within three
        points of the level for 400 fruit and more, else whether the binomial interval contains it.
    """
    if "low_m" not in readings:
        return pd.DataFrame()
    chosen = (readings["method"] == _COVERED[truth]) & readings["low_m"].notna()
    known = readings[chosen & readings[f"{truth}_m"].notna()]
    if known.empty:
        return pd.DataFrame()
    true_m = known[["centreline_m", "thread_m", "chord_m"]].bfill(axis=1).iloc[:, 0]
    everything = Factor("all", {"all": pd.Series(True, known.index)})
    rows = [
        {"factor": factor.head, "group": label, **_covered(known[inside], truth, level)}
        for factor in (everything, *factors_of(known, true_m))
        for label, inside in factor.groups.items()
        if inside.any()
    ]
    return pd.DataFrame(rows)


def _covered(inside: pd.DataFrame, truth: LengthDefinition, level: float) -> dict[str, object]:
    low, high = inside["low_m"], inside["high_m"]
    hits, count = int(inside[f"{truth}_m"].between(low, high).sum()), len(inside)
    bounds = binomial_interval(hits, count)
    fruit = inside["fruit"].nunique()
    if fruit >= _LARGE_GROUP:
        allowed = [level - 0.9 + share for share in _LARGE_GROUP_SHARE]
        as_stated = allowed[0] <= hits / count <= allowed[1]
    else:
        as_stated = bounds[0] <= level <= bounds[1]
    return {
        "captures": count,
        "fruit": fruit,
        "hits": hits,
        "low": bounds[0],
        "high": bounds[1],
        "width_percent": float((200 * (high - low) / (high + low)).mean()),
        "as_stated": as_stated,
    }


_COVERAGE = {
    "factor": "by",
    "group": "group",
    "captures": "captures",
    "fruit": "fruit",
    "share": "holds the truth (%):.1",
    "low": "95 % of that, low (%):.1",
    "high": "95 % of that, high (%):.1",
    "width_percent": "mean width (% of length):.1",
    "as_stated": "as stated",
}


def coverage_table(groups: pd.DataFrame, level: float = 0.9, title: str = "Coverage") -> Table:
    """Return the coverage by group as a table."""
    rows = groups.assign(
        share=100 * groups["hits"] / groups["captures"],
        low=100 * groups["low"],
        high=100 * groups["high"],
    )
    comment = (
        f"An interval that states {100 * level:.0f} % should hold the true length that often, in "
        "every group and not only over all. 'As stated': within three points in groups of 400 "
        "fruit and more; in smaller ones the binomial 95 % interval (Clopper and Pearson) "
        "contains the level. It takes captures for independent; those of one fruit are not. Fruit "
        "that M6 did not measure have no interval and are not counted here."
    )
    return Table.of_records(title, _COVERAGE, rows.to_dict("records"), comment)


def coverage_plot(groups: pd.DataFrame, level: float = 0.9) -> bytes:
    """Plot how often the interval holds the truth, by group, with binomial 95 % bars.

    Parameters
    ----------
    groups : DataFrame
        From `coverage_by_group`, at least one.
    level : float
        What the interval claims.
    """
    figure = new_figure(0.3 * len(groups) + 1.2)
    ax = figure.subplots()
    labels = []
    for k, row in enumerate(groups[::-1].itertuples()):
        share, colour = row.hits / row.captures, "#0072B2" if row.as_stated else "#D55E00"
        ax.plot([100 * row.low, 100 * row.high], [k, k], color=colour, linewidth=2)
        ax.plot(100 * share, k, "o" if row.as_stated else "D", color=colour)
        name = row.group if row.factor == row.group else f"{row.factor}: {row.group}"
        labels.append(f"{name} (n = {row.captures})")
    ax.set_yticks(range(len(groups)), labels, fontsize=9)
    ax.axvline(100 * level, color="black", linewidth=1, linestyle="--")
    ax.set_xlim(min(100 * groups["low"].min(), 100 * level - 10) - 2, 101)
    ax.set_xlabel(f"intervals that hold the truth (%); {100 * level:.0f} % is stated")
    ax.grid(alpha=0.3, axis="x")
    return as_png(figure)


def error_by_value_plot(
    scored: pd.DataFrame,
    truth: LengthDefinition,
    value: pd.Series[float],
    edges: ArrayLike,
    label: str,
) -> bytes:
    """Plot each method's mean relative error by a value of the fruit.

    Parameters
    ----------
    scored : DataFrame
        From `against`.
    truth : LengthDefinition
        What they are compared with.
    value : Series of float
        Of each row, such as its tilt.
    edges : array_like of float
        Bounds of the groups; the last one belongs to the last group.
    label : str
        What the value is, with its unit.
    """
    figure = new_figure(4.6)
    ax = figure.subplots()
    bounds = np.asarray(edges, float)
    bounds[-1] = np.nextafter(bounds[-1], np.inf)
    group = pd.cut(value, bounds, right=False)
    for method in shown_methods(scored, truth):
        own = scored["method"] == method
        by_group = pd.DataFrame({"error": scored["error_percent"], "value": value})[own].groupby(
            group[own], observed=True
        )
        means = by_group.mean()
        colour, marker, line = method_style(method)
        ax.plot(
            means["value"],
            means["error"].clip(lower=_SMALLEST_PERCENT),
            color=colour,
            marker=marker,
            linestyle=line,
            linewidth=2.4 if method.startswith("M6") else 1.2,
            label=method,
        )
    ax.set_xlim(left=-1)
    ax.set_yscale("log")
    ax.set_yticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    ax.set_xlabel(label)
    ax.set_ylabel(f"mean error against the {truth} (%)")
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return as_png(figure)
