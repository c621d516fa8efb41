"""A round as an Excel workbook: sheets of its tables, a summary with charts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.exports.tables import ExportTable
from cucumbervision.measurement.result import flag_remarks
from cucumbervision.pipeline.fields import Column
from cucumbervision.pipeline.tables import (
    HEAD_COLOR,
    cell_value,
)

if TYPE_CHECKING:
    from cucumbervision.exports.tables import RoundTables
    from cucumbervision.pipeline.fields import Cell

SHEETS = {
    "fruit": ("Fruit", 5),
    "stops": ("Stops", 2),
    "forecast": ("Forecast", 0),
    "picks": ("Pick list", 0),
    "work": ("Work", 0),
    "rows": ("Rows", 0),
    "provenance": ("Provenance", 0),
}


_FORMATS = {"cm": "0.0", "mm": "0.0", "m": "0.00", "g": "0", "ml": "0", "deg": "0.0", "h": "0.0"}


_WIDEST_PX = 480  # of a column
_A4 = 9
_CHART_PX = 375  # as wide as the first three columns of the summary
_NOT_PRINTED = frozenset({"key", "picture", "config_sha256"})


# Texts are written as texts, whatever they start with: never as formulas or links.
_SAFE = {"strings_to_formulas": False, "strings_to_urls": False, "strings_to_numbers": False}


def write_round_workbook(tables: RoundTables, out: Path) -> list[Path]:
    """Write `round.xlsx`: summary with charts, fruit, stops, forecast, picks, work, provenance.

    Heads have units and stay in place, numbers have formats, pictures are linked.
    """
    import xlsxwriter

    path = out / "round.xlsx"
    with xlsxwriter.Workbook(path, _SAFE) as book:
        book.set_properties(
            {
                "title": tables.title,
                "comments": f"{tables.provenance['software']}, {tables.provenance['licence']}, "
                f"{tables.provenance['source']}",
            }
        )
        writer = _Writer(book)
        summary = book.add_worksheet("Summary")
        writer.summary(summary, tables)
        for name, (title, frozen) in SHEETS.items():
            table = reading_table(tables) if name == "fruit" else tables[name]
            writer.table(book.add_worksheet(title), table, frozen)
        writer.columns(book.add_worksheet("Columns"), tables)
        writer.charts(summary, book.add_worksheet("Charts"), tables)
    return [path]


_READ = (
    Column("date", "", "text", "when it was seen, UTC"),
    Column("round", "", "text", "what the round is called"),
    Column("row", "", "text", "row of the house"),
    Column("position_m", "m", "number", "where along the row"),
    Column("fruit", "", "whole", "number of the fruit in the round"),
    Column("length_cm", "cm", "number", "length"),
    Column("low_cm", "cm", "number", "lower end of its 90 % interval"),
    Column("high_cm", "cm", "number", "upper end of its 90 % interval"),
    Column("class", "", "text", "likeliest class"),
    Column("remarks", "", "text", "what else to know, in words"),
)


_IS_READ = frozenset({"row", "along_m", "number", "length_cm", "grade"})


def reading_table(tables: RoundTables) -> ExportTable:
    """Return the fruit with ten columns to read before the others of `fruit.csv`."""
    table = tables["fruit"]
    others = [column for column in table.columns if column.name not in _IS_READ]
    rows = [
        (
            str(one["taken_utc"])[:10],
            tables.title,
            *(one[name] for name in ("row", "along_m", "number", "length_cm")),
            *(one[name] for name in ("interval_low_cm", "interval_high_cm", "grade")),
            fruit_remarks(one) or None,
            *(one[column.name] for column in others),
        )
        for one in table.records()
    ]
    return ExportTable("fruit", (*_READ, *others), tuple(rows))


def fruit_remarks(fruit: dict[str, Cell]) -> str:
    """Return what else to know of a line of `fruit`, in words.

    Examples
    --------
    >>> fruit_remarks({"flags": "part-hidden", "picked_utc": "2026-05-01", "simulated": True})
    'picked; drawn, not grown; partly hidden'
    """
    parts = (
        "picked" if fruit["picked_utc"] else "",
        "drawn, not grown" if fruit["simulated"] else "",
        flag_remarks(str(fruit["flags"] or "")),
    )
    return "; ".join(filter(None, parts))


class _Writer:
    """Writes sheets of one workbook."""

    def __init__(self, book: Any) -> None:
        self.book = book
        self.head = book.add_format(
            {"bold": True, "font_color": "white", "bg_color": HEAD_COLOR, "text_wrap": True}
        )
        self.bold = book.add_format({"bold": True, "font_size": 14})
        self.link = book.add_format({"font_color": "blue", "underline": 1})
        self._numbers: dict[str, Any] = {}

    def number(self, column: Column) -> Any:
        """Return the format of a column's cells; texts stand off the number before them."""
        shape = {"text": "@", "yes/no": '"yes";;"no"', "whole": "0"}.get(column.type)
        shape = shape or _FORMATS.get(column.unit, "0.00")
        if shape not in self._numbers:
            look = {"indent": 1} if shape == "@" else {"num_format": shape}
            self._numbers[shape] = self.book.add_format(look)
        return self._numbers[shape]

    def summary(self, sheet: Any, tables: RoundTables) -> None:
        """Write the one row of the summary as lines, and what it rests on."""
        sheet.set_column(0, 0, 20)
        sheet.set_column(1, 1, 26)
        sheet.set_column(2, 2, 6)
        sheet.set_column(3, 3, 66)
        _set_page(sheet, high=1)
        sheet.set_portrait()
        sheet.write_string(0, 0, str(cell_value(tables.title)), self.bold)
        sheet.write_row(1, 0, ("what", "value", "unit", "what it says"), self.head)
        sheet.freeze_panes(2, 0)
        facts = tables["summary"]
        for line, (column, cell) in enumerate(zip(facts.columns, facts.rows[0], strict=True), 2):
            sheet.write_row(line, 0, (column.title.split(" [")[0], "", column.unit, column.says))
            self.write(sheet, line, 1, cell, column)
        notes = [("no forecast", tables.note, "")] if tables.note else []
        for name in ("software", "licence", "source", "written_utc"):
            notes.append((name.replace("_", " "), tables.provenance[name], ""))
        for one in tables.provenance["hashes"]:
            notes.append((f"{one['kind']} SHA-256", one["name"], one["sha256"]))
        for line, (what, value, says) in enumerate(notes, 3 + len(facts.columns)):
            sheet.write_row(line, 0, (what, cell_value(value), "", cell_value(says)))

    def table(self, sheet: Any, table: ExportTable, frozen: int) -> None:
        """Write a table with its head, formats, filter and links."""
        for at, column in enumerate(table.columns):
            sheet.write_string(0, at, column.title, self.head)
            sheet.set_column(at, at, None, self.number(column))
        sheet.freeze_panes(1, frozen)
        if table.rows:
            sheet.autofilter(0, 0, len(table.rows), len(table.columns) - 1)
        for line, row in enumerate(table.rows, start=1):
            for at, (column, cell) in enumerate(zip(table.columns, row, strict=True)):
                self.write(sheet, line, at, cell, column)
        sheet.autofit(_WIDEST_PX)
        _set_page(sheet)
        sheet.print_area(0, 0, len(table.rows), _printed(table) - 1)

    def write(self, sheet: Any, line: int, at: int, cell: Cell, column: Column) -> None:
        """Write one cell as what it is."""
        if cell is None:
            return
        if isinstance(cell, bool):
            sheet.write_boolean(line, at, cell)
        elif isinstance(cell, int | float):
            sheet.write_number(line, at, cell, self.number(column))
        elif column.name == "picture":
            # Its letters, digits, dots and dashes are safe in a link, whatever a round is called.
            sheet.write_url(line, at, f"external:{cell}", self.link, "picture")
        else:
            sheet.write_string(line, at, str(cell_value(cell)))

    def columns(self, sheet: Any, tables: RoundTables) -> None:
        """Write what each column says."""
        sheet.set_column(0, 2, 18)
        sheet.set_column(3, 3, 70)
        sheet.write_row(0, 0, ("table", "column", "unit", "what it says"), self.head)
        shown = {**tables.tables, "fruit": reading_table(tables)}
        columns = [(table.name, one) for table in shown.values() for one in table.columns]
        for line, (name, one) in enumerate(columns, 1):
            sheet.write_row(line, 0, (name, one.name, one.unit, one.says))
        sheet.freeze_panes(1, 0)
        _set_page(sheet)

    def charts(self, summary: Any, sheet: Any, tables: RoundTables) -> None:
        """Draw the lengths and the forecast onto the summary; their figures stand on `sheet`."""
        bins, days = tables.charts.bins, tables.charts.days
        below = summary.dim_rowmax + 2
        sheet.set_column(0, 12, 12)
        _set_page(sheet)
        sheet.write_row(0, 0, ["length [cm]", "fruit"], self.head)
        for line, (low, high, count) in enumerate(bins, start=1):
            sheet.write_string(line, 0, f"{low}–{high}")
            sheet.write_number(line, 1, count)
        if bins:
            chart = self.book.add_chart({"type": "column"})
            chart.add_series(
                {
                    "name": "fruit on the plant",
                    "categories": ["Charts", 1, 0, len(bins), 0],
                    "values": ["Charts", 1, 1, len(bins), 1],
                    "fill": {"color": HEAD_COLOR},
                    "gap": 10,
                }
            )
            _axes(chart, "Lengths on the plant", "length [cm]")
            chart.set_legend({"none": True})
            chart.set_size({"width": _CHART_PX})
            summary.insert_chart(below, 0, chart)
        sheet.write_row(0, 4, ["day", *map(cell_value, tables.charts.classes)], self.head)
        for line, (day, counts) in enumerate(days, start=1):
            sheet.write_row(line, 4, [day, *counts])
        if days:
            chart = self.book.add_chart({"type": "column", "subtype": "stacked"})
            for k in range(len(tables.charts.classes)):
                chart.add_series(
                    {
                        "name": ["Charts", 0, 5 + k],
                        "categories": ["Charts", 1, 4, len(days), 4],
                        "values": ["Charts", 1, 5 + k, len(days), 5 + k],
                    }
                )
            _axes(chart, "Forecast: fruit by class if nothing is picked", "days from the round")
            summary.insert_chart(below, 3, chart)


def _printed(table: ExportTable) -> int:
    """Return how many of a table's columns are for people on paper."""
    if table.columns[: len(_READ)] == _READ:
        return len(_READ)
    names = [column.name for column in table.columns]
    most = len(names)
    # A key at the beginning is what a sheet goes by.
    return next((n for n, name in enumerate(names) if n > 1 and name in _NOT_PRINTED), most)


def _set_page(sheet: Any, high: int = 0) -> None:
    """Set a sheet up to print on A4, as wide as the paper, its header on every page."""
    sheet.set_paper(_A4)
    sheet.set_landscape()
    sheet.set_margins(left=0.4, right=0.4, top=0.5, bottom=0.6)
    sheet.fit_to_pages(1, high)
    sheet.repeat_rows(0)
    sheet.set_footer("&L&F: &A&Rpage &P of &N")


def _axes(chart: Any, title: str, x: str) -> None:
    chart.set_title({"name": title, "name_font": {"size": 11}})
    chart.set_x_axis({"name": x})
    chart.set_y_axis({"name": "fruit", "major_gridlines": {"visible": True}})
