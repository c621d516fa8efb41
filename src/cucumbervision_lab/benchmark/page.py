"""A report as one page of HTML that needs nothing else: tables, plots and sections."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cucumbervision.about import LICENCE, source_offer
from cucumbervision.accuracy.table import Table
from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from pathlib import Path

    from jinja2 import Template

HTML_NAME = "report.html"
JSON_NAME = "benchmark.json"


@dataclass(frozen=True)
class Plot:
    """A plot with what it shows.

    Parameters
    ----------
    caption : str
        In plain words.
    png : bytes
        The plot.
    """

    caption: str
    png: bytes


@dataclass(frozen=True)
class Section:
    """One part of the report.

    Parameters
    ----------
    title : str
        Its head.
    intro : tuple of str
        Paragraphs before the tables.
    entries : tuple of Table or Plot
        In order.
    """

    title: str
    intro: tuple[str, ...] = ()
    entries: tuple[Table | Plot, ...] = field(default=())

    def as_json(self) -> dict[str, Any]:
        """Return the title and the tables' numbers."""
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
    """Write `report.html`, which needs nothing else, and its numbers as `benchmark.json`.

    Parameters
    ----------
    out : Path
        The folder, made if it is missing.
    title : str
        The page's head.
    sections : sequence of Section
        In order.
    glance : Table
        What stands first.
    notes : sequence of str
        Paragraphs at the top.
    provenance : mapping of str to object, optional
        How the numbers came about: seeds, versions, machine, duration.
    glossary : sequence of (str, str)
        Terms and what they mean.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    MissingExtraError
        If Jinja2 is not installed.
    """
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
    """Return a value of the provenance as a reader would write it."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain_text(one)}" for name, one in value.items()) or "–"
    if isinstance(value, list | tuple):
        return "; ".join(_plain_text(one) for one in value) or "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value is None else str(value)


def _template() -> Template:
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ModuleNotFoundError:
        raise MissingExtraError("jinja2", "benchmark") from None
    environment = Environment(
        loader=PackageLoader("cucumbervision_lab.benchmark", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["anchor"] = _anchor
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    return environment.get_template("report.html")
