"""Write tables as CSV, Excel, Parquet and JSON row by row, and the files of a run."""

from __future__ import annotations

import json
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from statistics import fmean, median, stdev
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any, Self

import numpy as np

from cucumbervision.errors import Message, MissingExtraError, joined
from cucumbervision.files import cell_value, json_value
from cucumbervision.methods.flags import Flag, data_doubts, is_length_unknown, is_lower_bound
from cucumbervision.methods.result import Choice, Measurement
from cucumbervision.methods.table import AVAILABLE
from cucumbervision.run.fields import FIELDS, Cell, Column, Field
from cucumbervision.run.measurer import CaptureResult

FAILURE_COLUMNS = ("input", "capture", "error", "message")
HEAD_COLOR = "#2F6B3A"
MOST_EXCEL_ROWS = 1_048_575
"""Rows that a sheet of Excel takes below its head."""

_FORMATS = {"cm": "0.00", "mm": "0.0", "m": "0.00", "g": "0", "ml": "0", "deg": "0.0", "h": "0.0"}
_A4 = 9
_MEANING = ("column", "unit", "meaning")


# Depth steps other than 1 mm, in mm: D405 cameras, TUM's, L515 cameras, micrometres, cm, metres.
_STEPS = (0.1, 0.2, 0.25, 0.001, 10.0, 1000.0)
_USUAL_CM = (5.0, 50.0)


def _by_class(counts: Mapping[str, int]) -> Message:
    named = ((name or "without a name", count) for name, count in counts.items())
    return joined(Message("{count} of class {name}", count=n, name=name) for name, n in named)


@dataclass
class Summary:
    """Counts and lengths of a run; uses eight bytes per fruit.

    Parameters
    ----------
    captures, fruit : int
        Number of captures and of fruit, including fruit without a length.
    lengths_cm : array of float
        Lengths that are neither lower bounds nor unknown.
    lower_bounds, unknown : int
        Number of lower bounds of fruit that continue out of sight, and of lengths of which nothing
        is known (`flags.is_length_unknown`).
    refused_cm : list of float
        Lengths of fruit of implausible size.
    too_large : int
        Number of these that are too long or too thick.
    methods, masks : Counter
        Number of fruit by chosen method, and by source of the mask; '' for none.
    labels, left_out : Counter
        Number of fruit by class, and of detections of excluded classes.
    flags : Counter
        Number of fruit by flag.
    simulated : bool
        Whether some captures are simulated.
    models : list of dict
        The networks that were used.

    Examples
    --------
    >>> cells = {"length_cm": 12.5, "method": "M6", "mask_source": None, "simulated": False}
    >>> summary = Summary()
    >>> summary.add([cells, cells | {"length_cm": None, "method": None}])
    >>> summary.captures, summary.fruit, summary.measured, summary.methods
    (1, 2, 1, Counter({'M6': 1, '': 1}))
    """

    captures: int = 0
    fruit: int = 0
    lengths_cm: array[float] = field(default_factory=lambda: array("d"))
    lower_bounds: int = 0
    unknown: int = 0
    refused_cm: list[float] = field(default_factory=list)
    too_large: int = 0
    methods: Counter[str] = field(default_factory=Counter)
    masks: Counter[str] = field(default_factory=Counter)
    labels: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    flags: Counter[str] = field(default_factory=Counter)
    simulated: bool = False
    models: list[dict[str, Any]] = field(default_factory=list)

    @property
    def measured(self) -> int:
        """Number of fruit with a length."""
        return len(self.lengths_cm) + self.lower_bounds + self.unknown

    def add(
        self,
        rows: Iterable[Mapping[str, Cell]],
        models: Iterable[dict[str, Any]] = (),
        left_out: Mapping[str, int] | None = None,
    ) -> None:
        """Count a capture."""
        self.captures += 1
        self.left_out.update(left_out or {})
        for row in rows:
            self.fruit += 1
            flags = str(row.get("flags") or "").split()
            if row["length_cm"] is not None:
                if is_lower_bound(flags):
                    self.lower_bounds += 1
                elif is_length_unknown(flags):
                    self.unknown += 1
                else:
                    self.lengths_cm.append(float(row["length_cm"]))
            self.methods[str(row["method"] or "")] += 1
            refused = row.get("reason")
            large = Flag.DEPTH_UNIT in flags
            if refused == Choice.IMPLAUSIBLE or (refused == Choice.IMPLAUSIBLE_DIAMETER and large):
                self.too_large += large
                read = [row[f"{method.lower()}_cm"] for method in reversed(AVAILABLE)]
                self.refused_cm.append(next(float(x) for x in read if x is not None))
            self.masks[str(row["mask_source"] or "")] += 1
            self.labels[str(row.get("label") or "")] += 1
            self.flags.update(flags)
            self.simulated = self.simulated or bool(row["simulated"])
        self.models += [model for model in models if model not in self.models]

    def doubts(self) -> list[str]:
        """Return one line for each doubt about the data, with the remedy."""
        return [*self.unit_hints(), *self._class_notes(), *data_doubts(self.flags, self.fruit)]

    def _class_notes(self) -> list[str]:
        """Return a note on measured and excluded classes, if there are several.

        Examples
        --------
        >>> Summary(labels=Counter(cucumber=2, leaf=1))._class_notes()
        ['measured as fruit: 2 of class cucumber, 1 of class leaf; --classes chooses among them']
        """
        notes: list[str] = []
        if len(self.labels) > 1:
            note = "measured as fruit: {classes}; --classes chooses among them"
            notes.append(Message(note, classes=_by_class(self.labels)))
        if self.left_out:
            notes.append(Message("left out: {classes}", classes=_by_class(self.left_out)))
        return notes

    def unit_hints(self) -> list[str]:
        """Return likely explanations if all sizes are impossible, or half too large.

        Examples
        --------
        >>> Summary(refused_cm=[148.0, 180.0], fruit=2).unit_hints()[0]
        'no fruit has a possible size (median 164 cm): is one step of depth really 1 mm? ...'
        """
        sized = len(self.refused_cm) + self.measured
        if not self.refused_cm or (self.measured and 2 * self.too_large < sized):
            return []
        middle = median(self.refused_cm)
        fault = "no fruit has a possible size (median {size:.3g} cm)"
        if self.measured:
            fault = "{count} of {fruit} fruit are too large (median {size:.3g} cm)"
        fault = Message(fault, count=self.too_large, fruit=sized, size=middle)
        steps = [s / 1000 for s in _STEPS if _USUAL_CM[0] <= middle * s <= _USUAL_CM[1]]
        doubt = "is one step of depth really 1 mm? --depth-unit {steps} would explain it"
        if not steps:
            doubt = "do the intrinsics belong to this camera's colour at this size?"
        asked = joined((Message("{step:g}", step=s) for s in steps), "{first} or {second}")
        return [Message("{fault}: {doubt}", fault=fault, doubt=Message(doubt, steps=asked))]

    def lines(self, failures: int, provenance: Mapping[str, Any]) -> list[tuple[str, Any]]:
        """Return pairs of label and value for the first sheet of the workbook.

        Parameters
        ----------
        failures : int
            Number of captures that could not be read, measured or written.
        provenance : mapping
            As `tables.provenance_of` returns it.
        """
        lines: list[tuple[str, Any]] = [
            ("Captures", self.captures),
            ("Fruit", self.fruit),
            ("Fruit measured", self.measured),
            ("of these only in part (lower bounds)", self.lower_bounds),
            ("of these uncertain (left out of the statistics)", self.unknown),
            ("Inputs that could not be read", failures),
        ]
        if self.simulated:
            lines.append(("Note", "some of these captures are simulated"))
        lines += self._statistics()
        for what, counts in (("method", self.methods), ("source of the mask", self.masks)):
            named = sorted((name or "none", count) for name, count in counts.items())
            lines += [(f"Fruit by {what} {name}", count) for name, count in named]
        lines += [
            ("Software", provenance["software"]),
            ("Licence", provenance["licence"]),
            ("Source", provenance["source"]),
            ("Started (UTC)", provenance["started"]),
            ("Configuration SHA-256", provenance["config_sha256"]),
        ]
        if provenance["calibration"]:
            lines.append(("Calibration", provenance["calibration"]["tag"]))
        return lines + [
            (f"Plug-in {m['name']}", f"{m['package']} {m['version']}".strip())
            if "package" in m
            else (f"Model {m['name']}", f"{m['runtime']} {m['sha256']}")
            for m in self.models
        ]

    def _statistics(self) -> list[tuple[str, Any]]:
        lengths_cm = self.lengths_cm
        if not lengths_cm:
            return []
        lines = [
            ("Mean length [cm]", round(fmean(lengths_cm), 2)),
            ("Median length [cm]", round(median(lengths_cm), 2)),
            ("Shortest [cm]", round(min(lengths_cm), 2)),
            ("Longest [cm]", round(max(lengths_cm), 2)),
        ]
        if len(lengths_cm) > 1:
            lines.append(("Standard deviation [cm]", round(stdev(lengths_cm), 2)))
        return lines


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
        """Write rows of cells, one below the other, from the row `start` on."""
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
    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    fields = [
        pa.field(column.name, kinds[column.python_type], metadata=described)
        for column in columns
        for described in ({"unit": column.unit, "says": column.says},)
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
