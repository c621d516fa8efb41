"""Write what was measured: CSV as it comes, Excel and JSON at the end."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING, Any

from cucumbervision.pipeline.rows import COLUMNS, defused

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from cucumbervision.pipeline.rows import Cell

__all__ = ["FAILURE_COLUMNS", "CsvSink", "cell_value", "write_json", "write_workbook"]

FAILURE_COLUMNS = ("input", "capture", "error", "message")
HEAD_COLOR = "#2F6B3A"


class CsvSink:
    """A CSV file that grows row by row, so that what was measured outlives a crash.

    Parameters
    ----------
    path : Path
        Written anew; UTF-8 with a byte order mark, which Excel needs to read accents.
    columns : sequence of str
        The head.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> with CsvSink(path, ["name", "length_cm"]) as sink:
    ...     sink.write({"name": "=1+1", "length_cm": 12.5})
    >>> path.read_text(encoding="utf-8-sig").split()
    ['name,length_cm', "'=1+1,12.5"]
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._stream = path.open("w", newline="", encoding="utf-8-sig")
        self._columns = list(columns)
        self._writer = csv.writer(self._stream)
        self._writer.writerow(self._columns)

    def write(self, row: Mapping[str, Any]) -> None:
        """Append one row; texts are defused, None leaves the cell empty."""
        self._writer.writerow([cell_value(row[name]) for name in self._columns])
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stream.close()


def cell_value(value: Cell) -> str | int | float | None:
    """Give what a spreadsheet's cell holds: texts defused, true and false as words.

    Examples
    --------
    >>> cell_value("@home"), cell_value(True), cell_value(-1.5)
    ("'@home", 'true', -1.5)
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    return defused(value) if isinstance(value, str) else value


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Write a report as JSON, UTF-8, one value a line."""
    path.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def write_workbook(
    path: Path, rows: Sequence[Mapping[str, Cell]], summary: Sequence[tuple[str, Any]]
) -> None:
    """Write the rows as an Excel file: the fruit, a summary, and what each column means.

    Parameters
    ----------
    path : Path
        The .xlsx file.
    rows : sequence of mapping
        As `session.rows.fruit_row` fills them.
    summary : sequence of (str, value)
        Lines of the summary sheet.
    """
    import xlsxwriter

    # Texts are written as texts, whatever they start with: never as formulas or links.
    safe = {"strings_to_formulas": False, "strings_to_urls": False, "strings_to_numbers": False}
    with xlsxwriter.Workbook(path, safe) as book:
        head = book.add_format({"bold": True, "font_color": "white", "bg_color": HEAD_COLOR})
        head.set_text_wrap()
        sheet = book.add_worksheet("Summary")
        sheet.set_column(0, 0, 34)
        sheet.set_column(1, 1, 60)
        for line, (what, value) in enumerate(summary):
            sheet.write_string(line, 0, what)
            _write(sheet, line, 1, value)
        _fruit_sheet(book, rows, head)
        sheet = book.add_worksheet("Columns")
        sheet.set_column(0, 2, 24)
        for column, text in enumerate(("column", "unit", "what it says")):
            sheet.write_string(0, column, text, head)
        for line, item in enumerate(COLUMNS, start=1):
            for column, text in enumerate((item.name, item.unit, item.says)):
                sheet.write_string(line, column, text)


def _fruit_sheet(book: Any, rows: Sequence[Mapping[str, Cell]], head: Any) -> None:
    sheet = book.add_worksheet("Fruit")
    two_digits = book.add_format({"num_format": "0.00"})
    for index, column in enumerate(COLUMNS):
        plain = column.name.rsplit("_", 1)[0] if column.unit else column.name
        title = f"{plain.replace('_', ' ')} [{column.unit}]" if column.unit else column.name
        sheet.write_string(0, index, title.replace("_", " "), head)
        sheet.set_column(index, index, 12, two_digits if column.unit == "cm" else None)
        for line, row in enumerate(rows, start=1):
            _write(sheet, line, index, cell_value(row[column.name]))
    sheet.set_row(0, 32)
    sheet.freeze_panes(1, 3)
    sheet.autofilter(0, 0, max(len(rows), 1), len(COLUMNS) - 1)


def _write(sheet: Any, line: int, column: int, value: Any) -> None:
    if value is None:
        return
    if isinstance(value, int | float) and not isinstance(value, bool):
        sheet.write_number(line, column, value)
    else:
        sheet.write_string(line, column, str(value))
