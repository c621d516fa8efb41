from __future__ import annotations

from pathlib import Path
from typing import Any

import openpyxl
import pytest

from cucumbervision.run.fields import FIELDS
from cucumbervision.run.tables import MOST_EXCEL_ROWS, Summary, excel_limit, write_workbook


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


def measured_row(
    m6_cm: float, reason: str = "mask-points-ge-100", flags: str = ""
) -> dict[str, Any]:
    length = None if reason.startswith("implausible") else m6_cm
    cells = {"length_cm": length, "method": None, "mask_source": None, "simulated": False}
    others = {f"m{k}_cm": None for k in range(1, 6)}
    return {**cells, **others, "m6_cm": m6_cm, "reason": reason, "flags": flags}


SOUND = measured_row(18.0)
STEM = measured_row(30.0, "implausible-diameter", "ends-unsure")
SHORT = measured_row(4.0, "implausible-length")
THICK = measured_row(74.0, "implausible-diameter", "ends-unsure depth-unit")
DOUBTED = measured_row(37.0, flags="depth-unit")


@pytest.mark.parametrize(
    ("rows", "hint"),
    [
        ([SOUND, THICK, SOUND], None),
        ([STEM, SHORT, SOUND], None),
        ([STEM], None),
        ([SHORT], "no fruit has a possible size (median 4 cm): is one step of depth really 1 mm? "
         "--depth-unit 0.01 would explain it"),
        ([THICK, THICK, DOUBTED], "2 of 3 fruit are too large (median 74 cm): is one step of depth "
         "really 1 mm? --depth-unit 0.0001, 0.0002 or 0.00025 would explain it"),
    ],
)  # fmt: skip
def test_a_unit_is_suggested_where_half_of_the_fruit_are_too_large(
    rows: list[dict[str, Any]], hint: str | None
) -> None:
    summary = Summary()
    summary.add(rows)
    assert summary.unit_hints() == ([] if hint is None else [hint])


def test_several_classes_and_what_was_left_out_are_told() -> None:
    summary = Summary()
    summary.add([SOUND | {"label": "cucumber"}, SOUND | {"label": "leaf"}], left_out={"stem": 2})
    told = summary.doubts()
    assert told[0].startswith("measured as fruit: 1 of class cucumber, 1 of class leaf; --classes")
    assert told[1] == "left out: 2 of class stem"


def test_doubts_of_the_data_are_told_once_with_the_remedy() -> None:
    summary = Summary()
    for flags in ("principal-point", "ends-unsure principal-point", ""):
        summary.add([measured_row(18.0, flags=flags)])
    (line,) = summary.doubts()
    assert line.startswith("2 of 3 fruit: the intrinsics' principal point lies off the middle")
    assert "check that" in line


def test_bounds_and_unknown_lengths_are_left_out_of_the_statistics() -> None:
    """Of 18, 20, 9 (in part), 40 and 60 cm (of which nothing is known) the mean is 19 cm."""
    summary = Summary()
    flags = ("end-hidden", "depth-sparse", "end-covered interval-too-wide")
    bound, sparse, wide = (
        measured_row(length_cm, flags=codes)
        for length_cm, codes in zip((9.0, 40.0, 60.0), flags, strict=True)
    )
    summary.add([SOUND, measured_row(20.0), bound, sparse, wide])
    provenance = dict.fromkeys(("software", "licence", "source", "started", "config_sha256"), "")
    lines = dict(summary.lines(0, provenance | {"calibration": None}))
    assert lines["Fruit measured"] == 5
    assert lines["of these only in part (lower bounds)"] == 1
    assert lines["of these uncertain (left out of the statistics)"] == 2
    assert (lines["Mean length [cm]"], lines["Longest [cm]"]) == (19.0, 20.0)
