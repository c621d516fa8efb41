"""A table as data: heads with units, rows, and what it means in plain words."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.files import json_value

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Cell", "Column", "Table"]

Cell = str | int | float | bool | None


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

    def show(self, cell: Cell) -> str:
        """Give a cell as text; an en dash where there is no number.

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
        heads: Sequence[str],
        rows: Sequence[Sequence[Any]],
        comment: str = "",
        decimals: int = 2,
    ) -> Table:
        """Make a table of plain heads, all with as many decimals.

        Examples
        --------
        >>> table = Table.of("Burst", ["frames", "MAPE (%)"], [[1, 0.9], [5, 0.75]])
        >>> table.text_rows()
        [['1', '0.90'], ['5', '0.75']]
        """
        columns = tuple(Column(head, decimals) for head in heads)
        cells = tuple(tuple(map(_python, row)) for row in rows)
        return cls(title, columns, cells, comment)

    @property
    def numeric(self) -> list[bool]:
        """Whether each column holds nothing but numbers and gaps, which are set to the right."""
        return [
            all(isinstance(row[k], int | float | None) for row in self.rows)
            for k in range(len(self.columns))
        ]

    def text_rows(self) -> list[list[str]]:
        """Give every cell as text."""
        return [
            [column.show(cell) for column, cell in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]

    def as_json(self) -> dict[str, Any]:
        """Give the table with its numbers in full; what is no number becomes null.

        Examples
        --------
        >>> Table.of("a", ["b"], [[float("nan")]]).as_json()["rows"]
        [{'b': None}]
        """
        heads = [column.head for column in self.columns]
        return {
            "title": self.title,
            "comment": self.comment,
            "rows": [json_value(dict(zip(heads, row, strict=True))) for row in self.rows],
        }


def _python(cell: Any) -> Cell:
    """Give numpy's numbers as Python's own, which JSON knows."""
    value: Cell = cell.item() if hasattr(cell, "item") else cell
    return value
