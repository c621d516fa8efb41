"""Tables of results for the terminal and for files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cucumbervision.files import json_value

Cell = str | int | float | bool | None


@dataclass(frozen=True)
class ReportColumn:
    """A column's heading and number format.

    Parameters
    ----------
    head : str
        Heading with unit.
    decimals : int
        Number of decimals of floats.
    signed : bool
        Whether to show a plus sign.
    """

    head: str
    decimals: int = 2
    signed: bool = False

    @classmethod
    def of(cls, head: str) -> ReportColumn:
        """Create a column from a heading with an optional format suffix.

        Examples
        --------
        >>> ReportColumn.of("bias (%):+.1"), ReportColumn.of("fruit").decimals
        (ReportColumn(head='bias (%)', decimals=1, signed=True), 2)
        """
        text, _, form = head.partition(":")
        return cls(text, int(form[-1]), form[0] == "+") if form else cls(head)

    def show(self, cell: Cell) -> str:
        """Format a cell as text; an en dash for a missing number.

        Examples
        --------
        >>> column = ReportColumn("bias (%)", 1, signed=True)
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
class ReportTable:
    """A table of a report.

    Parameters
    ----------
    title : str
        Title.
    columns : tuple of ReportColumn
        Columns.
    rows : tuple of tuple
        Rows, each with a cell for every column.
    comment : str
        Explanation of the table.

    Raises
    ------
    ValueError
        If the number of cells in a row differs from the number of columns.
    """

    title: str
    columns: tuple[ReportColumn, ...]
    rows: tuple[tuple[Cell, ...], ...]
    comment: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"'{self.title}': {len(row)} cells in a row of {len(self.columns)} columns"
                )

    @classmethod
    def of(
        cls, title: str, heads: Iterable[str], rows: Iterable[Sequence[Any]], comment: str = ""
    ) -> ReportTable:
        """Create a table from headings in the format of `ReportColumn.of`.

        Examples
        --------
        >>> table = ReportTable.of("Burst", ["frames", "MAPE (%):.1"], [[1, 0.9], [5, 0.75]])
        >>> table.text_rows()
        [['1', '0.9'], ['5', '0.8']]
        """
        cells = tuple(tuple(map(_python, row)) for row in rows)
        return cls(title, tuple(map(ReportColumn.of, heads)), cells, comment)

    @classmethod
    def of_records(
        cls,
        title: str,
        columns: Mapping[str, str],
        records: Iterable[Mapping[str, Any]],
        comment: str = "",
    ) -> ReportTable:
        """Create a table from records; `columns` maps names to headings.

        Examples
        --------
        >>> rows = [{"method": "M1", "bias": 1.25, "count": 3}]
        >>> columns = {"method": "method", "bias": "bias (%):+.1"}
        >>> ReportTable.of_records("a", columns, rows).text_rows()
        [['M1', '+1.2']]
        """
        rows = ([record[name] for name in columns] for record in records)
        return cls.of(title, columns.values(), rows, comment)

    @property
    def numeric(self) -> list[bool]:
        """Whether each column contains only numbers and missing values, which are right-aligned."""
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
        """Return the table with unrounded numbers; NaN becomes null.

        Examples
        --------
        >>> ReportTable.of("a", ["b"], [[float("nan")]]).as_json()["rows"]
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
    """Convert NumPy numbers to Python numbers for JSON."""
    value: Cell = cell.item() if hasattr(cell, "item") else cell
    return value
