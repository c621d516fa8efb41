"""Tables of a round and their columns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.measurement.result import Method
from cucumbervision.pipeline.fields import FIELDS, Field, read_fields
from cucumbervision.store.records import DetectionRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from cucumbervision.pipeline.fields import Cell


@dataclass(frozen=True)
class Table:
    """One table.

    Parameters
    ----------
    name : str
        Name of the file or sheet.
    columns : tuple of Field
        Columns.
    rows : list of dict
        Cells by column name.
    """

    name: str
    columns: tuple[Field, ...]
    rows: list[dict[str, Cell]]

    @classmethod
    def of(cls, name: str, lines: Iterable[Any]) -> Table:
        """Create one of the tables of `COLUMNS`; empty text becomes an empty cell."""
        columns = COLUMNS[name]
        rows = [{one.name: _cell(one, line) for one in columns} for line in lines]
        return cls(name, columns, rows)


def _cell(column: Field, line: Any) -> Cell:
    cell = column.of(line)
    return None if cell == "" else cell


@dataclass(frozen=True)
class RoundTables:
    """All tables of a round for export.

    Parameters
    ----------
    title : str
        Name of the round, or its key.
    provenance : mapping
        Software, source, time, key of the round, and hashes of configuration, models, calibration
        and profile, as JSON values.
    tables : mapping of str to Table
        'summary' (one row), 'rows', 'fruit', 'stops', 'forecast', 'picks', 'work' and
        'provenance', in this order.
    bins : tuple of (from_cm, to_cm, fruit)
        Histogram of the lengths on the plant.
    pictures : mapping of str to callable
        Functions that create the JPEG files, by the name in the column `picture`.
    note : str
        Reason for a missing forecast.
    """

    title: str
    provenance: Mapping[str, Any]
    tables: Mapping[str, Table]
    bins: tuple[tuple[int, int, int], ...] = ()
    pictures: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    note: str = ""

    def __getitem__(self, name: str) -> Table:
        """Return a table by its name."""
        return self.tables[name]

    @property
    def summary(self) -> dict[str, Cell]:
        """The row of the summary."""
        return self.tables["summary"].rows[0]


def _kept(one: Field) -> Field | None:
    """Return the stored field of a fruit for a field of `measurements.csv`, or None.

    Lengths are stored as `Length` values.
    """
    inside = one.path.removeprefix("fruit.")
    if not inside.startswith(("length.", "raw_length.")):
        inside = one.si_name
    known = hasattr(DetectionRecord, inside.partition(".")[0])
    return replace(one, path=f"view.record.{inside}") if known else None


_KEPT = {one.name: kept for one in FIELDS if (kept := _kept(one)) is not None}
_METHODS = tuple(
    replace(one, path=f"methods.{method}")
    for method in Method
    for one in FIELDS
    if one.name == f"{method.lower()}_cm"
)


def _columns() -> dict[str, tuple[Field, ...]]:
    """Read `columns.csv`: a line without description is a stored field, '*' all remaining ones."""
    found = read_fields(Path(__file__).with_name("columns.csv"))
    named = {line["name"] for line, _ in found if line["table"] == "fruit"}
    rest = [*(one for name, one in _KEPT.items() if name not in named), *_METHODS]
    columns: dict[str, list[Field]] = {}
    for line, one in found:
        table = columns.setdefault(line["table"], [])
        kept = rest if one.name == "*" else [_KEPT.get(one.name, one)]
        table += [one] if one.says else kept
    return {name: tuple(table) for name, table in columns.items()}


COLUMNS = _columns()
"""Columns of each table, in order."""
