"""Write tables as CSV, Excel, Parquet and JSON row by row, and the files of a run."""

from __future__ import annotations

import json
from itertools import islice
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import MissingExtraError
from cucumbervision.files import cell_value, json_value, write_csv
from cucumbervision.run.fields import FIELDS
from cucumbervision.run.measurer import Boundary, Failure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path
    from types import ModuleType
    from typing import Self

    from cucumbervision.methods.result import Measurement
    from cucumbervision.run.fields import Cell, Column, Field
    from cucumbervision.run.folder import CaptureRecord, OutputFolder
    from cucumbervision.run.measurer import CaptureResult
    from cucumbervision.run.summary import Summary

FAILURE_COLUMNS = ("input", "capture", "error", "message")
HEAD_COLOR = "#2F6B3A"
MOST_EXCEL_ROWS = 1_048_575
"""Rows that a sheet of Excel takes below its head."""

PARQUET = "parquet"
_PART_ROWS = 100_000
_FORMATS = {"cm": "0.00", "mm": "0.0", "m": "0.00", "g": "0", "ml": "0", "deg": "0.0", "h": "0.0"}
_A4 = 9
_MEANING = ("column", "unit", "meaning")


class Workbook:
    """An Excel file as a context manager, written with constant memory.

    Text is never converted to formulas or links. Sheets print on A4 at full width, with the
    headings on every page.

    Parameters
    ----------
    path : Path
        The .xlsx file.

    Raises
    ------
    OSError
        If it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        import xlsxwriter

        path.touch()  # fails before the rows are computed
        # Its sheets are temporary files until it is closed; the folder is always removed.
        self._sheets = TemporaryDirectory(prefix="cucumbervision-")
        safe = {"strings_to_formulas": False, "strings_to_urls": False, "strings_to_numbers": False}
        how = {**safe, "constant_memory": True, "tmpdir": self._sheets.name}
        self.book = book = xlsxwriter.Workbook(path, how)
        self.head = book.add_format(
            {"bold": True, "font_color": "white", "bg_color": HEAD_COLOR, "text_wrap": True}
        )
        self._numbers = {unit: book.add_format({"num_format": f}) for unit, f in _FORMATS.items()}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        from xlsxwriter.exceptions import FileCreateError

        with self._sheets:
            try:
                if kind is None:
                    self.book.close()
            except FileCreateError as error:
                raise error.args[0] from None
            finally:
                self.book.fileclosed = (
                    True  # an incomplete book must not be written when it is garbage-collected
                )

    def sheet(self, title: str, widths: Sequence[int] = (), pages_high: int = 0) -> Any:
        """Return a new sheet with the widths of its first columns and a maximum of pages."""
        sheet = self.book.add_worksheet(title)
        for number, width in enumerate(widths):
            sheet.set_column(number, number, width)
        sheet.set_paper(_A4)
        sheet.set_landscape()
        sheet.set_margins(left=0.4, right=0.4, top=0.5, bottom=0.6)
        sheet.fit_to_pages(1, pages_high)
        sheet.set_footer("&L&F: &A&Rpage &P of &N")
        return sheet

    def table(
        self,
        title: str,
        columns: Sequence[Column],
        rows: Iterable[Mapping[str, Cell]],
        frozen: int = 0,
        printed: int | None = None,
    ) -> None:
        """Write a table with fixed headings, number formats and filters.

        Parameters
        ----------
        title : str
            Title of the sheet.
        columns : sequence of Column
            The columns.
        rows : iterable of mapping
            The rows; each is written before the next is requested.
        frozen : int
            Number of fixed columns.
        printed : int, optional
            Number of printed columns; all by default.
        """
        sheet = self.sheet(title)
        sheet.repeat_rows(0)
        sheet.set_row(0, 32)
        for number, column in enumerate(columns):
            column_width = min(max(12, len(column.title)), 24)
            sheet.set_column(number, number, column_width, self._numbers.get(column.unit))
            sheet.write_string(0, number, column.title, self.head)
        line = 0
        for line, row in enumerate(rows, start=1):
            for number, column in enumerate(columns):
                self.write(sheet, line, number, row[column.name], column)
        sheet.freeze_panes(1, frozen)
        sheet.autofilter(0, 0, max(line, 1), len(columns) - 1)
        sheet.print_area(0, 0, line, (printed or len(columns)) - 1)

    def write(
        self, sheet: Any, line: int, number: int, cell: Cell, column: Column | None = None
    ) -> None:
        """Write one cell by its type."""
        if isinstance(cell, bool):
            sheet.write_boolean(line, number, cell)
        elif isinstance(cell, int | float):
            sheet.write_number(line, number, cell, column and self._numbers.get(column.unit))
        elif cell not in (None, ""):
            sheet.write_string(line, number, str(cell_value(cell)))

    def lines(self, sheet: Any, lines: Iterable[Sequence[Cell]], start: int = 0) -> None:
        """Write lines of cells below each other."""
        for line, cells in enumerate(lines, start):
            for number, cell in enumerate(cells):
                self.write(sheet, line, number, cell)


def write_workbook(
    path: Path,
    rows: Iterable[Mapping[str, Cell]],
    summary: Sequence[tuple[str, Any]],
    most_rows: int = MOST_EXCEL_ROWS,
    fields: Sequence[Field] = FIELDS,
) -> None:
    """Write an Excel file with the fruit, a summary, and the meaning of the columns.

    Parameters
    ----------
    path : Path
        The .xlsx file.
    rows : iterable of mapping
        As returned by `fields.fruit_row`; each is written before the next is requested.
    summary : sequence of (str, value)
        Lines of the summary sheet.
    most_rows : int
        Maximum number of rows, by default that of an Excel sheet.
    fields : sequence of Field
        Columns of the rows.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    with Workbook(path) as book:
        book.lines(book.sheet("Summary", (34, 60)), summary)
        book.table("Fruit", fields, islice(rows, most_rows), frozen=3)
        meaning = ((fruit_field.name, fruit_field.unit, fruit_field.says) for fruit_field in fields)
        book.lines(book.sheet("Columns", (24, 24, 60)), (_MEANING, *meaning))


def import_arrow() -> ModuleType:
    """Import pyarrow with its Parquet part.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        raise MissingExtraError("pyarrow", "export") from None
    module: ModuleType = pyarrow
    return module


def write_parquet(
    path: Path,
    columns: Iterable[Column],
    rows: list[dict[str, Cell]],
    provenance: Mapping[str, Any],
) -> None:
    """Write a table as Parquet, with unit and description of each column, and provenance.

    Raises
    ------
    MissingExtraError
        If pyarrow is not installed.
    """
    pa = import_arrow()
    kinds: dict[str, Any] = {
        "text": pa.string(),
        "whole": pa.int64(),
        "number": pa.float64(),
        "yes/no": pa.bool_(),
    }
    fields = [
        pa.field(
            column.name, kinds[column.type], metadata={"unit": column.unit, "says": column.says}
        )
        for column in columns
    ]
    metadata = {"cucumbervision": json.dumps(dict(provenance), ensure_ascii=False)}
    schema = pa.schema(fields, metadata=metadata)
    pa.parquet.write_table(pa.Table.from_pylist(rows, schema=schema), path)


def capture_json(result: CaptureResult, rows: Sequence[Mapping[str, Cell]]) -> dict[str, Any]:
    """Return one capture for `measurements.json`: camera, provenance, fruit, every method.

    Parameters
    ----------
    result : CaptureResult
        The capture.
    rows : sequence of mapping
        The rows of its fruit, in the same order.
    """
    capture = result.capture
    return {
        "name": capture.name,
        "frame": capture.frame,
        "source": capture.source,
        "simulated": capture.simulated,
        "intrinsics": {"stream": "", **json_value(vars(capture.intrinsics))},
        "provenance": json_value(dict(capture.provenance)),
        "fill": round(capture.fill, 4),
        "left_out": dict(result.left_out),
        "fruit": [
            {
                **row,
                "pose": fruit.pose and fruit.pose.as_json(),
                "methods": {str(m): _method_json(x) for m, x in fruit.measurements.items()},
            }
            for row, fruit in zip(rows, result.fruit, strict=True)
        ],
    }


def _method_json(measurement: Measurement) -> dict[str, Any]:
    path = measurement.path_m
    return {
        "length_m": measurement.length_m,
        "kind": measurement.kind and str(measurement.kind),
        "reason": str(measurement.reason),
        "fallback": list(measurement.fallback),
        "tips_m": None if path is None else np.round(path[[0, -1]], 5).tolist(),
    }


def rows_of(records: Iterable[CaptureRecord]) -> Iterator[dict[str, Cell]]:
    """Yield the rows of all fruit, in order."""
    for record in records:
        yield from record.rows


def write_reports(
    out: OutputFolder,
    records: Callable[[], Iterator[CaptureRecord]],
    summary: Summary,
    failures: Sequence[Failure],
    provenance: Mapping[str, Any],
    *,
    fields: Sequence[Field] = FIELDS,
    parquet: bool = False,
) -> list[Failure]:
    """Write the tables of a run; a failed table keeps its previous version.

    Parameters
    ----------
    out : OutputFolder
        Output folder.
    records : callable
        Returns a new iterator of the run's captures, in order.
    summary : Summary
        Summary of the same captures.
    failures : sequence of Failure
        Captures that could not be read, measured or written.
    provenance : mapping
        As `provenance_of` returns it.
    fields : sequence of Field
        The columns of the rows.
    parquet : bool
        Whether to also write `parquet/`.

    Returns
    -------
    list of Failure
        One for each table that could not be written.
    """
    written: list[Failure] = []
    with Boundary(written, str(out.path)), out.replacing("measurements.csv") as path:
        write_csv(path, [fruit_field.name for fruit_field in fields], rows_of(records()))
    with (
        Boundary(written, str(out.path)),
        out.replacing("measurements.json") as path,
        path.open("w", encoding="utf-8", errors="backslashreplace") as file,
    ):
        file.writelines(_json_pieces(provenance, records(), failures))
    with Boundary(written, str(out.path)), out.replacing("measurements.xlsx") as path:
        lines = [*excel_limit(summary.fruit), *summary.lines(len(failures), provenance)]
        write_workbook(path, rows_of(records()), lines, fields=fields)
    if parquet:
        with Boundary(written, str(out.path)):
            _write_parts(out, rows_of(records()), provenance, fields)
    with Boundary(written, str(out.path)), out.replacing("failures.csv") as path:
        write_csv(path, FAILURE_COLUMNS, (vars(failure) for failure in (*failures, *written)))
    return written


def excel_limit(fruit: int, most_rows: int = MOST_EXCEL_ROWS) -> list[tuple[str, str]]:
    """Return a line for the summary of the workbook if an Excel sheet cannot hold all fruit.

    Examples
    --------
    >>> excel_limit(5, most_rows=5)
    []
    >>> excel_limit(7, most_rows=5)[0][1]
    'Excel takes 5 rows a sheet: the last 2 fruit are in measurements.csv and .json alone'
    """
    if fruit <= most_rows:
        return []
    missing = fruit - most_rows
    text = f"Excel takes {most_rows} rows a sheet: the last {missing} fruit are in measurements.csv"
    return [("Not all fruit are here", f"{text} and .json alone")]


def _json_pieces(
    provenance: Mapping[str, Any], records: Iterable[CaptureRecord], failures: Iterable[Failure]
) -> Iterator[str]:
    """Yield the text of `measurements.json` by capture, one value per line."""
    yield json.dumps(dict(provenance), indent=1, ensure_ascii=False).removesuffix("\n}")
    yield ',\n "captures": ['
    yield from _json_items(record.capture for record in records)
    yield ',\n "failures": ['
    yield from _json_items(vars(failure) for failure in failures)
    yield "\n}\n"


def _json_items(values: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    first = True
    for value in values:
        text = json.dumps(value, indent=1, ensure_ascii=False).replace("\n", "\n  ")
        yield f"{'' if first else ','}\n  {text}"
        first = False
    yield "]" if first else "\n ]"


def _write_parts(
    out: OutputFolder,
    rows: Iterator[dict[str, Cell]],
    provenance: Mapping[str, Any],
    fields: Sequence[Field],
) -> None:
    """Write `parquet/part-00000.parquet` and so on, and remove further parts of an earlier run."""
    names = set[str]()
    # Without fruit, one empty part defines the columns.
    while (part := list(islice(rows, _PART_ROWS))) or not names:
        name = f"part-{len(names):05d}.parquet"
        with out.replacing(f"{PARQUET}/{name}") as path:
            write_parquet(path, fields, part, provenance)
        names.add(name)
    for old in (out.path / PARQUET).glob("part-*.parquet"):
        if old.name not in names:
            old.unlink()
