"""Write a report with tables and plots as a self-contained HTML page."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cucumbervision.about import LICENCE, source_offer
from cucumbervision.accuracy.table import Table
from cucumbervision_lab.benchmark.length_tables import comparable_readings, shown_methods
from cucumbervision_lab.benchmark.records import require_extra

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd
    from jinja2 import Template
    from matplotlib.figure import Figure

    from cucumbervision.measurement.result import LengthDefinition

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
    page = _template().render(
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
    (out / HTML_NAME).write_text(page, encoding="utf-8")
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
