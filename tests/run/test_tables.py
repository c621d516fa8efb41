from __future__ import annotations

from pathlib import Path
from typing import Any

import openpyxl

from cucumbervision.run.fields import FIELDS
from cucumbervision.run.tables import MOST_EXCEL_ROWS, excel_limit, write_workbook


def row(**cells: Any) -> dict[str, Any]:
    return {column.name: cells.get(column.name) for column in FIELDS}


def test_workbook_holds_rows_units_and_summary(tmp_path: Path) -> None:
    path = tmp_path / "a.xlsx"
    rows = [
        row(capture="=1+1", fruit=1, length_cm=25.1234, length_kind="surface-arc"),
        row(capture="https://example.org", fruit=2),
    ]
    write_workbook(path, rows, [("Fruit", 2), ("Note", "=2+2")])
    book = openpyxl.load_workbook(path)
    assert book.sheetnames == ["Summary", "Fruit", "Columns"]
    sheet = book["Fruit"]
    head = [cell.value for cell in sheet[1]]
    assert head[0] == "capture"
    length = head.index("length [cm]")
    assert "position [m]" in head
    assert sheet.freeze_panes == "D2"
    assert sheet.cell(2, length + 1).value == 25.1234
    assert sheet.cell(2, length + 1).number_format == "0.00"
    first = sheet.cell(2, 1)
    assert (first.value, first.data_type) == ("'=1+1", "s")
    assert sheet.cell(3, 1).hyperlink is None
    assert sheet.cell(3, length + 1).value is None
    assert book["Summary"]["B1"].value == 2
    assert book["Summary"]["B2"].data_type == "s"
    assert next(c.value for c in book["Columns"][2]) == "capture"


def test_a_sheet_of_excel_ends_with_a_word(tmp_path: Path) -> None:
    path = tmp_path / "a.xlsx"
    rows = (row(capture=name, fruit=1) for name in "abc")
    write_workbook(path, rows, excel_limit(3, most_rows=2), most_rows=2)
    book = openpyxl.load_workbook(path)
    assert [cell.value for cell in book["Fruit"]["A"]] == ["capture", "a", "b"]
    assert "the last 1 fruit are in measurements.csv" in book["Summary"]["B1"].value
    assert MOST_EXCEL_ROWS == 2**20 - 1
