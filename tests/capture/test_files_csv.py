from __future__ import annotations

import csv
from pathlib import Path

import pytest

from cucumbervision.capture.files import defused, write_csv


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
    assert defused(f"{start}cmd") == f"'{start}cmd"


def test_plain_text_stays() -> None:
    assert defused("row-3 = left") == "row-3 = left"
    assert defused("") == ""
