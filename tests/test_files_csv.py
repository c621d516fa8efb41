from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from cucumbervision.files import cell_value, write_csv


def test_csv_cells(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    first = {"a": "=HYPERLINK(1)", "b": None, "c": True, "d": -1.5}
    write_csv(path, "abcd", [first, {"a": 'say "é", b', "b": 0, "c": False, "d": "-1.5"}])
    with path.open(newline="", encoding="utf-8-sig") as stream:
        rows = list(csv.reader(stream))
    assert rows[1] == ["'=HYPERLINK(1)", "", "true", "-1.5"]
    assert rows[2] == ['say "é", b', "0", "false", "'-1.5"]


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r"])
def test_formulas_are_defused(start: str) -> None:
    assert cell_value(f"{start}cmd") == f"'{start}cmd"


def test_plain_text_stays() -> None:
    assert cell_value("row-3 = left") == "row-3 = left"
    assert cell_value("") == ""


EVIL = [
    "x;=cmd|'/c calc'!A0",
    'x;"=1+1"',
    "x; +1",
    "x\t=1",
    "x\n@sum(1)",
    "x\r\n-1",
    ";;=1",
    "x;\u3000\uff1d1",
    "\"x\";''=1",
    "=1;=2;=3",
]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("name", EVIL)
def test_no_spreadsheet_finds_a_formula_wherever_it_parts_the_cells(
    tmp_path: Path, name: str, separator: str
) -> None:
    path = tmp_path / "a.csv"
    write_csv(path, ["row", "note"], [{"row": name, "note": name}])
    text = path.read_text(encoding="utf-8-sig")
    with path.open(encoding="utf-8-sig", newline="") as file:
        cells = [cell for line in csv.reader(file, delimiter=separator) for cell in line]
    if separator != ",":  # in the worst case: quotes keep nothing together
        cells += re.split(rf"[{separator}\r\n]", text)
    begun = [cell.lstrip(' \u3000"')[:1] for cell in cells]
    assert not set(begun) & set("=+-@\uff1d")


def test_a_semicolon_alone_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_csv(path, ["row"], [{"row": "north; 3 = left"}])
    assert path.read_text(encoding="utf-8-sig").splitlines()[1] == "north; 3 = left"
