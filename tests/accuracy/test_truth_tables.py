from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.accuracy.truth import parse_number, read_table
from cucumbervision.errors import CucumberVisionError

COMMAS = "Capture,fruit,length_cm\r\nreihe-ä,1,23.5\r\n"
SEMICOLONS = "Capture;fruit;length_cm\r\nreihe-ä;1;23,5\r\n"


@pytest.mark.parametrize("text", [COMMAS, SEMICOLONS, COMMAS.replace(",", "\t")])
@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_whatever_a_spreadsheet_writes(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(code))
    table = read_table(path)
    assert table.columns == ("capture", "fruit", "length_cm")
    (line,) = table.lines
    assert line.number == 2
    assert line.cells["capture"] == "reihe-ä"
    assert parse_number(line.cells["length_cm"]) == 23.5


def test_excels_separator_line_and_blank_lines_are_counted_but_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("sep=;\na;b\n\n;\n1;2\n")
    table = read_table(path)
    assert table.columns == ("a", "b")
    assert [(line.number, line.cells) for line in table.lines] == [(5, {"a": "1", "b": "2"})]


def test_a_guarded_text_loses_its_apostrophe(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("a,b\n'=x,'plain\n")
    assert read_table(path).lines[0].cells == {"a": "=x", "b": "'plain"}


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "the file is empty"),
        (b"\xef\xbb\xbf\r\n", "the file is empty"),
        (b"a,A\n1,2\n", "line 1: column 'a' is there twice"),
        (b",".join(b"%d" % k for k in range(200_000)), "line 1 names 200000 columns; a table"),
        (b"a,b\n1,2\n1,2,5\n", "line 3 has 3 cells, the head 2"),
        (b"\xff\xfe\x00", "is not text"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(CucumberVisionError, match=text) as caught:
        read_table(path)
    assert str(path) in str(caught.value)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CucumberVisionError, match="cannot be read"):
        read_table(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("text", "value"),
    [("23.5", 23.5), ("23,5", 23.5), ("-1", -1), ("1.234,5", None), ("nan", None), ("x", None)],
)
def test_numbers(text: str, value: float | None) -> None:
    assert parse_number(text) == value
