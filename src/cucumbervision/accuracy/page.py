"""A report: tables, pictures and sections, set out as one page of HTML that needs nothing else."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision.capture.files import json_value
from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from pathlib import Path

    from jinja2 import Template

Cell = str | int | float | bool | None
HTML_NAME = "report.html"
JSON_NAME = "benchmark.json"


@dataclass(frozen=True)
class Column:
    """A column's head and how its numbers are shown.

    Parameters
    ----------
    head : str
        What it is, with its unit.
    decimals : int
        Digits after the point of numbers with a fraction.
    signed : bool
        Whether a plus is shown.
    """

    head: str
    decimals: int = 2
    signed: bool = False

    @classmethod
    def of(cls, head: str) -> Column:
        """Return the column of a head that may end in how its numbers are shown.

        Examples
        --------
        >>> Column.of("bias (%):+.1"), Column.of("fruit").decimals
        (Column(head='bias (%)', decimals=1, signed=True), 2)
        """
        text, _, form = head.partition(":")
        return cls(text, int(form[-1]), form[0] == "+") if form else cls(head)

    def show(self, cell: Cell) -> str:
        """Return a cell as text; an en dash where there is no number.

        Examples
        --------
        >>> column = Column("bias (%)", 1, signed=True)
        >>> column.show(1.26), column.show(float("nan")), column.show(True), column.show(7)
        ('+1.3', '–', 'yes', '7')
        """
        if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
            return "–"
        if isinstance(cell, bool):
            return "yes" if cell else "no"
        if isinstance(cell, float):
            return f"{cell:{'+' if self.signed else ''}.{self.decimals}f}".replace("-", "−")
        return str(cell)


@dataclass(frozen=True)
class Table:
    """A table of a report.

    Parameters
    ----------
    title : str
        What it shows.
    columns : tuple of Column
        Its heads.
    rows : tuple of tuple
        Its cells, as many a row as there are columns.
    comment : str
        How to read it, in plain words.
    bold : frozenset of (int, int)
        Row and column of the cells to set in bold.

    Raises
    ------
    ValueError
        If a row has another number of cells than there are columns.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    comment: str = ""
    bold: frozenset[tuple[int, int]] = field(default=frozenset())

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"'{self.title}': {len(row)} cells in a row of {len(self.columns)} columns"
                )

    @classmethod
    def of(
        cls,
        title: str,
        heads: Iterable[str],
        rows: Iterable[Sequence[Any]],
        comment: str = "",
        bold: frozenset[tuple[int, int]] = frozenset(),
    ) -> Table:
        """Return a table of heads in words, as `Column.of` reads them.

        Examples
        --------
        >>> table = Table.of("Burst", ["frames", "MAPE (%):.1"], [[1, 0.9], [5, 0.75]])
        >>> table.text_rows()
        [['1', '0.9'], ['5', '0.8']]
        """
        cells = tuple(tuple(map(_python, row)) for row in rows)
        return cls(title, tuple(map(Column.of, heads)), cells, comment, bold)

    @classmethod
    def of_records(
        cls,
        title: str,
        columns: Mapping[str, str],
        records: Iterable[Mapping[str, Any]],
        comment: str = "",
        bold: frozenset[tuple[int, int]] = frozenset(),
    ) -> Table:
        """Return a table of records' values by name: `columns` says which, under which heads.

        Examples
        --------
        >>> rows = [{"method": "M1", "bias": 1.25, "count": 3}]
        >>> Table.of_records("a", {"method": "method", "bias": "bias (%):+.1"}, rows).text_rows()
        [['M1', '+1.2']]
        """
        rows = ([record[name] for name in columns] for record in records)
        return cls.of(title, columns.values(), rows, comment, bold)

    @property
    def numeric(self) -> list[bool]:
        """Whether each column holds nothing but numbers and gaps, which are set to the right."""
        return [
            all(isinstance(row[k], int | float | None) for row in self.rows)
            for k in range(len(self.columns))
        ]

    def text_rows(self) -> list[list[str]]:
        """Return every cell as text."""
        return [
            [column.show(cell) for column, cell in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]

    def as_json(self) -> dict[str, Any]:
        """Return the table with its numbers in full; what is no number becomes null.

        Examples
        --------
        >>> Table.of("a", ["b"], [[float("nan")]]).as_json()["rows"]
        [{'b': None}]
        """
        heads = [column.head for column in self.columns]
        return {
            "title": self.title,
            "comment": self.comment,
            "rows": [
                {head: json_value(cell) for head, cell in zip(heads, row, strict=True)}
                for row in self.rows
            ],
        }


def _python(cell: Any) -> Cell:
    """Return numpy's numbers as Python's own, which JSON knows."""
    value: Cell = cell.item() if hasattr(cell, "item") else cell
    return value


@dataclass(frozen=True)
class Picture:
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
    entries : tuple of Table or Picture
        In order.
    """

    title: str
    intro: tuple[str, ...] = ()
    entries: tuple[Table | Picture, ...] = field(default=())

    def as_json(self) -> dict[str, Any]:
        """Return the title and the tables' numbers."""
        tables = [entry.as_json() for entry in self.entries if isinstance(entry, Table)]
        return {"title": self.title, "tables": tables}


def write_report(
    out: Path,
    title: str,
    glance: Table,
    sections: Sequence[Section],
    *,
    notes: Sequence[tuple[str, str]] = (),
    provenance: Mapping[str, object] | None = None,
    glossary: Sequence[tuple[str, str]] = (),
    numbers: Mapping[str, object] | None = None,
) -> Path:
    """Write `report.html` and `benchmark.json`.

    Parameters
    ----------
    out : Path
        The folder, made if it is missing.
    title : str
        The page's head.
    glance : Table
        What stands first.
    sections : sequence of Section
        The rest, in order.
    notes : sequence of (str, str)
        Heads (or nothing) and texts at the top, paragraphs parted by an empty line.
    provenance : mapping of str to object, optional
        How the numbers came about: seeds, versions, machine, duration.
    glossary : sequence of (str, str)
        Terms and what they mean.
    numbers : mapping of str to object, optional
        What else `benchmark.json` is to say.

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
    origin.setdefault("versions", _plain_text(installed_versions()))
    page = render_page(title, notes, glance, sections, origin, glossary=glossary)
    content = {
        "title": title,
        "notes": {head or "summary": text for head, text in notes},
        "provenance": origin,
        **(numbers or {}),
        "glance": glance.as_json(),
        "sections": [section.as_json() for section in sections],
    }
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    out.mkdir(parents=True, exist_ok=True)
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
    glossary: Sequence[tuple[str, str]] = (),
    numbers: str = JSON_NAME,
) -> str:
    """Return a report as one page of HTML that needs nothing else.

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
        glance=glance,
        sections=sections,
        glossary=glossary,
        provenance=[(name, _plain_text(value)) for name, value in provenance.items()],
        licence=LICENCE,
        source=source_offer(),
        numbers=numbers,
    )


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
        raise MissingExtraError("jinja2", "report") from None
    environment = Environment(
        loader=PackageLoader("cucumbervision.accuracy", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["anchor"] = _anchor
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    return environment.get_template("report.html")
