"""The typed tables between a round and every file that is written of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from cucumbervision.exports.charts import Charts

__all__ = ["Cell", "ExportColumn", "RoundTables", "Table"]

Cell: TypeAlias = str | int | float | bool | None
_NUMBER: dict[str, type] = {"text": str, "whole": int, "number": float, "yes/no": bool}


@dataclass(frozen=True)
class ExportColumn:
    """One column.

    Parameters
    ----------
    name : str
        As in CSV, Parquet and JSON; ends with the unit where there is one.
    unit : str
        The unit; empty where there is none.
    type : str
        'text', 'whole', 'number' or 'yes/no'; every cell may also be empty.
    says : str
        What it is.
    """

    name: str
    unit: str
    type: str
    says: str

    @property
    def title(self) -> str:
        """The head that people read, with the unit.

        Examples
        --------
        >>> ExportColumn("chord_cm", "cm", "number", "straight from end to end").title
        'chord [cm]'
        """
        plain = self.name.removesuffix(f"_{self.unit}") if self.unit else self.name
        words = plain.replace("_", " ")
        return f"{words} [{self.unit}]" if self.unit else words


@dataclass(frozen=True)
class Table:
    """One table.

    Parameters
    ----------
    name : str
        Of its file or sheet.
    columns : tuple of ExportColumn
        Its columns.
    rows : tuple of tuple
        A cell for each column.

    Raises
    ------
    ValueError
        If a row has another number of cells, or a cell another type.

    Examples
    --------
    >>> column = ExportColumn("stops", "", "whole", "number of stops")
    >>> Table("summary", (column,), (("3",),))
    Traceback (most recent call last):
    ...
    ValueError: summary.stops holds '3', which is not whole
    """

    name: str
    columns: tuple[ExportColumn, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {self.name} has {len(row)} cells")
            for column, cell in zip(self.columns, row, strict=True):
                if cell is not None and type(cell) is not _NUMBER[column.type]:
                    raise ValueError(
                        f"{self.name}.{column.name} holds {cell!r}, which is not {column.type}"
                    )

    def records(self) -> list[dict[str, Cell]]:
        """Give the rows as mappings by column."""
        names = [column.name for column in self.columns]
        return [dict(zip(names, row, strict=True)) for row in self.rows]

    @classmethod
    def of(
        cls, name: str, columns: tuple[ExportColumn, ...], records: list[dict[str, Any]]
    ) -> Table:
        """Make a table of mappings; numbers become what their columns are."""
        rows = tuple(tuple(_cell(record[c.name], c.type) for c in columns) for record in records)
        return cls(name, columns, rows)


def _cell(value: Any, kind: str) -> Cell:
    if value is None or value == "" or value != value:  # not a number
        return None
    made: Cell = _NUMBER[kind](value)
    return made


@dataclass(frozen=True)
class RoundTables:
    """A round, ready to be written.

    Parameters
    ----------
    title : str
        The round's name, or its key.
    provenance : mapping
        Software, source, when it was written, the round's key, and the hashes of configuration,
        models, calibration and profile, as JSON values.
    tables : mapping of str to Table
        'summary' (one row), 'rows', 'fruit', 'stops', 'forecast', 'picks', 'work' and
        'provenance', in this order.
    charts : Charts
        What is drawn.
    pictures : mapping of str to Path
        Files to copy beside the tables, by the name that the column `picture` gives.
    note : str
        Why there is no forecast, if there is none.
    """

    title: str
    provenance: Mapping[str, Any]
    tables: Mapping[str, Table]
    charts: Charts
    pictures: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""

    def __getitem__(self, name: str) -> Table:
        """Give a table by its name."""
        return self.tables[name]

    @property
    def summary(self) -> dict[str, Cell]:
        """The one row of the summary."""
        return self.tables["summary"].records()[0]
