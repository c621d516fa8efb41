"""Write the benchmark's report as one page of HTML: the paper's figures, then every suite."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pandas as pd

from cucumbervision.about import LICENCE, source_offer
from cucumbervision.accuracy.statistics import estimate, score
from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.length_tables import (
    PAPER_METHODS,
    accuracy_table,
    comparable_readings,
    factors_of,
    group_table,
    shown_methods,
    span_text,
    truths_of,
)
from cucumbervision_lab.benchmark.records import Masks, require_extra

if TYPE_CHECKING:
    from pathlib import Path

    from jinja2 import Template
    from matplotlib.figure import Figure


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
    return write_report(
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
            entries.append(Plot(caption, predicted_against_truth(readings, truth)))
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


HTML_NAME = "report.html"
JSON_NAME = "benchmark.json"


@dataclass(frozen=True)
class Plot:
    """A plot with its caption.

    Parameters
    ----------
    caption : str
        Caption.
    png : bytes
        The plot as PNG.
    """

    caption: str
    png: bytes


@dataclass(frozen=True)
class Section:
    """A section of the report.

    Parameters
    ----------
    title : str
        Heading.
    intro : tuple of str
        Paragraphs before the tables.
    entries : tuple of Table or Plot
        Tables and plots in order.
    """

    title: str
    intro: tuple[str, ...] = ()
    entries: tuple[Table | Plot, ...] = field(default=())

    def as_json(self) -> dict[str, Any]:
        """Return the title and the tables as JSON values."""
        tables = [entry.as_json() for entry in self.entries if isinstance(entry, Table)]
        return {"title": self.title, "tables": tables}


def write_report(
    out: Path,
    title: str,
    sections: Sequence[Section],
    *,
    glance: Table,
    notes: Sequence[str] = (),
    provenance: Mapping[str, object] | None = None,
    glossary: Sequence[tuple[str, str]] = (),
) -> Path:
    """Write a self-contained `report.html`, and its numbers as `benchmark.json`.

    Parameters
    ----------
    out : Path
        Output folder; created if missing.
    title : str
        Title of the page.
    sections : sequence of Section
        Sections in order.
    glance : Table
        Summary table at the top.
    notes : sequence of str
        Paragraphs at the top.
    provenance : mapping of str to object, optional
        Seeds, versions, machine and duration.
    glossary : sequence of (str, str)
        Terms and their definitions.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    MissingExtraError
        As `require_extra`.
    """
    require_extra()
    origin = {name: _plain_text(value) for name, value in (provenance or {}).items()}
    html = _template().render(
        title=title,
        notes=notes,
        glance=glance,
        sections=sections,
        glossary=glossary,
        provenance=origin.items(),
        licence=LICENCE,
        source=source_offer(),
        numbers=JSON_NAME,
    )
    content = {
        "title": title,
        "notes": list(notes),
        "provenance": origin,
        "glance": glance.as_json(),
        "sections": [section.as_json() for section in sections],
    }
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    out.mkdir(parents=True, exist_ok=True)
    (out / JSON_NAME).write_text(text + "\n", encoding="utf-8")
    (out / HTML_NAME).write_text(html, encoding="utf-8")
    return out / HTML_NAME


def _anchor(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _plain_text(value: object) -> str:
    """Format a value of the provenance."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain_text(one)}" for name, one in value.items()) or "–"
    if isinstance(value, list | tuple):
        return "; ".join(_plain_text(one) for one in value) or "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value is None else str(value)


def _template() -> Template:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("cucumbervision_lab.benchmark", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["anchor"] = _anchor
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    return environment.get_template("report.html")


_DPI = 110
_WIDTH_IN = 10.0


# Okabe and Ito's colour-blind-safe palette; each method also has its own marker.
STYLES: dict[str, tuple[str, str, str]] = {
    "M1": ("#E69F00", "v", "-"),
    "M2": ("#56B4E9", "s", "-"),
    "M3": ("#009E73", "D", "-"),
    "M4": ("#CC79A7", "^", "-"),
    "M5": ("#0072B2", "o", "-"),
    "M6": ("#D55E00", "*", "-"),
    "skan": ("#777777", "x", ":"),
    "PlantCV": ("#777777", "+", "--"),
}


def predicted_against_truth(readings: pd.DataFrame, truth: LengthDefinition) -> bytes:
    """Plot predicted against true lengths with a panel for each method.

    Parameters
    ----------
    readings : DataFrame
        Readings of one suite and one kind of masks from `readings_frame`.
    truth : LengthDefinition
        Definition of length.

    Returns
    -------
    bytes
        The plot as PNG. Missing lengths are drawn at the bottom.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    scored = comparable_readings(readings, truth)
    methods = shown_methods(scored, truth)
    columns = min(4, len(methods))
    lines = -(-len(methods) // columns)
    figure = new_figure(2.6 * lines + 0.5)
    axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    drawn = scored[scored["method"].isin(methods)]
    top = 100 * float(drawn[["true_m", "length_m"]].max().max())
    for ax, method in zip(axes.flat, methods, strict=False):
        read, (colour, marker, _) = drawn[drawn["method"] == method], method_style(method)
        refused = int(read["length_m"].isna().sum())
        ax.plot([0, top], [0, top], color="black", linewidth=0.8)
        lengths_cm = 100 * read["length_m"].fillna(0)
        ax.scatter(100 * read["true_m"], lengths_cm, s=16, c=colour, marker=marker, alpha=0.7)
        ax.set_title(f"{method}: {refused} not measured" if refused else method, fontsize=10)
        ax.set_xlim(0, 1.03 * top)
        ax.set_ylim(-0.03 * top, 1.03 * top)
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(methods) :]:
        ax.set_visible(False)
    figure.supxlabel(f"true {truth} (cm)")
    figure.supylabel("measured (cm)")
    return as_png(figure)


def method_style(method: str) -> tuple[str, str, str]:
    """Return the colour, marker and line style of a method."""
    return STYLES.get(method) or STYLES.get(method.split()[0]) or ("#777777", ".", "-")


def new_figure(height_in: float) -> Figure:
    """Return an empty figure with the width of the report."""
    from matplotlib.figure import Figure

    return Figure(figsize=(_WIDTH_IN, height_in), dpi=_DPI, layout="constrained")


def as_png(figure: Figure) -> bytes:
    """Render a figure as PNG, reproducibly."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
