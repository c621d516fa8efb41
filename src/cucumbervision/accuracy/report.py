"""The report: one page of HTML that needs nothing else, and its numbers as JSON."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision.accuracy.sections import (
    GLOSSARY,
    Picture,
    Section,
    glance_table,
    record_sections,
)
from cucumbervision.accuracy.table import Table
from cucumbervision.errors import CucumberVisionError, MissingExtraError

if TYPE_CHECKING:
    from pathlib import Path

    from jinja2 import Template

    from cucumbervision.accuracy.records import Record

__all__ = ["HTML_NAME", "JSON_NAME", "SUMMARY", "render_page", "write_report"]

HTML_NAME = "report.html"
JSON_NAME = "benchmark.json"
SUMMARY = "summary"  # the note that stands at the top


def write_report(
    records: Sequence[Record],
    out: Path,
    *,
    title: str,
    notes: Mapping[str, str] | Sequence[str] | None = None,
    before: Sequence[Section] = (),
    after: Sequence[Section] = (),
    provenance: Mapping[str, object] | None = None,
    level: float = 0.9,
) -> Path:
    """Write `report.html` and `benchmark.json`.

    Parameters
    ----------
    records : sequence of Record
        Of any suites and masks; each suite and kind of masks becomes a section.
    out : Path
        The folder, made if it is missing.
    title : str
        The page's head.
    notes : mapping of str to str, or sequence of str, optional
        Plain texts (a sequence: the summary's paragraphs), paragraphs parted by an empty line:
        'summary' stands at the top, any other under its key as head, below it.
    before, after : sequence of Section
        Further sections before and after those of the records.
    provenance : mapping of str to object, optional
        How the numbers came about: seeds, versions, machine, duration.
    level : float
        Level that the records' intervals state.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    CucumberVisionError
        If there are no records.
    MissingExtraError
        If matplotlib or Jinja2 is not installed.
    """
    if not records:
        raise CucumberVisionError(
            "there is nothing to report", source=out, remedy="measure at least one fruit first"
        )
    texts = (
        dict(notes or {}) if isinstance(notes, Mapping | None) else {SUMMARY: "\n\n".join(notes)}
    )
    sections = [*before, *record_sections(records, level), *after]
    origin = {name: _plain_text(value) for name, value in (provenance or {}).items()}
    origin.setdefault("versions", _plain_text(installed_versions()))
    glance = glance_table(records)
    page = render_page(title, _ordered(texts), glance, sections, origin)
    out.mkdir(parents=True, exist_ok=True)
    numbers = {
        "title": title,
        "notes": texts,
        "provenance": origin,
        "interval_level": level,
        "records": len(records),
        "glance": glance.as_json(),
        "sections": [_section_json(section) for section in sections],
    }
    text = json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
    (out / JSON_NAME).write_text(text + "\n", encoding="utf-8")
    (out / HTML_NAME).write_text(page, encoding="utf-8")
    return out / HTML_NAME


def render_page(
    title: str,
    notes: Sequence[tuple[str, str]],
    glance: Table,
    sections: Sequence[Section],
    provenance: Mapping[str, object],
    *,
    glossary: Sequence[tuple[str, str]] = GLOSSARY,
    numbers: str = JSON_NAME,
) -> str:
    """Set a report out as one page of HTML that needs nothing else.

    Parameters
    ----------
    title : str
        The page's head.
    notes : sequence of (str, str)
        Heads and texts at the top, paragraphs parted by an empty line.
    glance : Table
        What stands first.
    sections : sequence of Section
        The rest, in order.
    provenance : mapping of str to object
        How the numbers came about.
    glossary : sequence of (str, str)
        Terms and what they mean.
    numbers : str
        Name of the file beside it that holds all numbers.

    Raises
    ------
    MissingExtraError
        If Jinja2 is not installed.
    """
    return _template().render(
        title=title,
        notes=notes,
        glance=_shown(glance),
        sections=[_section_shown(section) for section in sections],
        glossary=glossary,
        provenance=[(name, _plain_text(value)) for name, value in provenance.items()],
        licence=LICENCE,
        source=source_offer(),
        numbers=numbers,
    )


def _ordered(notes: dict[str, str]) -> list[tuple[str, str]]:
    first = [("", notes[SUMMARY])] if SUMMARY in notes else []
    return first + [(head, text) for head, text in notes.items() if head != SUMMARY]


def _section_shown(section: Section) -> dict[str, Any]:
    return {
        "title": section.title,
        "anchor": _anchor(section.title),
        "intro": section.intro,
        "entries": [_shown(entry, section.title) for entry in section.entries],
    }


def _shown(entry: Table | Picture, section_title: str = "") -> dict[str, Any]:
    if isinstance(entry, Picture):
        data = base64.b64encode(entry.png).decode("ascii")
        return {"kind": "picture", "caption": entry.caption, "data": data}
    return {
        "kind": "table",
        "title": entry.title,
        "anchor": _anchor(f"{section_title} {entry.title}"),
        "comment": entry.comment,
        "heads": [column.head for column in entry.columns],
        "numeric": entry.numeric,
        "rows": entry.text_rows(),
        "bold": entry.bold,
    }


def _section_json(section: Section) -> dict[str, Any]:
    tables = [entry.as_json() for entry in section.entries if isinstance(entry, Table)]
    return {"title": section.title, "tables": tables}


def _anchor(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _plain_text(value: object) -> str:
    """Give a value of the provenance as a reader would write it."""
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
        raise MissingExtraError("jinja2", "report") from None
    environment = Environment(
        loader=PackageLoader("cucumbervision.accuracy", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("report.html")
