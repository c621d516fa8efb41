from __future__ import annotations

from pathlib import Path

import pytest
from tests.accuracy.conftest import HEAD, write

from cucumbervision.accuracy.truth import floor_of, parse_number, read_table, read_truth
from cucumbervision.errors import CucumberVisionError, TruthError
from cucumbervision.methods.result import LengthDefinition


def test_repeats_as_columns_and_as_lines_are_the_same(tmp_path: Path) -> None:
    columns = read_truth(
        write(
            tmp_path,
            "capture,fruit,specimen,length_1_cm,length_2_cm,kind",
            "a,1,s1,20.0,20.2,thread",
            "a,2,s2,10.0,,Thread",
        )
    )
    lines = read_truth(
        write(
            tmp_path,
            "capture,fruit,specimen,repeat,length_cm,kind",
            "a,1,s1,1,20.0,thread",
            "a,1,s1,2,20.2,thread",
            "a,2,s2,1,10.0,thread",
        )
    )
    for truth in (columns, lines):
        first, second = truth.lengths
        assert first.lengths_m == pytest.approx((0.200, 0.202))
        assert first.length_m == pytest.approx(0.201)
        assert (first.capture, first.fruit, first.kind) == ("a", 1, LengthDefinition.THREAD)
        assert second.lengths_m == (0.1,)
        assert truth.specimens_named


def test_floor_is_pooled_by_hand(tmp_path: Path) -> None:
    truth = read_truth(
        write(
            tmp_path,
            "capture,fruit,specimen,length_1_cm,length_2_cm,length_3_cm,kind",
            "a,1,s1,10.0,10.2,10.4,thread",
            "b,3,s1,10.0,10.2,10.4,thread",  # the same fruit again: no new measurement
            "a,2,s2,20.0,20.1,,thread",
            "a,3,s3,30.0,,,thread",
        )
    )
    floor = floor_of(truth.lengths)
    assert floor is not None
    # Squares about the means: 2 x 2^2 = 8 mm2 with two degrees, 2 x 0.5^2 = 0.5 mm2 with one.
    assert floor.sd_mm == pytest.approx((8.5 / 3) ** 0.5)
    relative = 2 * (0.2 / 10.2) ** 2 + 2 * (0.05 / 20.05) ** 2
    assert floor.sd_percent == pytest.approx(100 * (relative / 3) ** 0.5)
    assert (floor.specimens, floor.measurements) == (2, 5)
    assert floor_of(truth.lengths[-1:]) is None


def test_one_fruit_by_two_kinds_and_fruit_that_were_missed(tmp_path: Path) -> None:
    truth = read_truth(
        write(
            tmp_path,
            HEAD + ",specimen,colour",
            "a,1,20,thread,s1,green",
            "a,1,18,chord,s1,green",
            "a,missed,15,thread,s2,green",
            "a,missed,16,thread,s3,green",
        )
    )
    assert [t.fruit for t in truth.lengths] == [1, 1, None, None]
    assert truth.unused == ("colour",)


def test_without_specimens_each_fruit_of_each_capture_is_its_own(tmp_path: Path) -> None:
    truth = read_truth(write(tmp_path, HEAD, "a,1,20,thread", "b,1,20,thread"))
    assert not truth.specimens_named
    assert len({t.specimen for t in truth.lengths}) == 2


def test_a_line_written_twice_alike_counts_once(tmp_path: Path) -> None:
    truth = read_truth(write(tmp_path, HEAD, "a,1,20,thread", "a,1,20.0,thread"))
    assert [t.lengths_m for t in truth.lengths] == [(0.2,)]


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        ([HEAD], "a head but no lines"),
        (["capture,fruit,kind", "a,1,thread"], "has no column length_cm"),
        (["capture,length_mm,kind", "a,230,thread"], "has no column fruit, length_cm"),
        ([HEAD, "a,1,20,thread", "a,2,zwanzig,thread"], "line 3: length_cm 'zwanzig' is no"),
        ([HEAD, "a,1,-20,thread"], "line 2: length_cm '-20' is not a positive number"),
        ([HEAD, "a,1,0,thread"], "line 2: length_cm '0' is not a positive number"),
        ([HEAD, "a,1,nan,thread"], "line 2: length_cm 'nan'"),
        ([HEAD, "a,1,,thread"], "line 2: has no length"),
        ([HEAD, "a,1,20,diagonal"], "line 2: 'diagonal' is not a kind of length"),
        ([HEAD, "a,first,20,thread"], "line 2: 'first' is not the number of a fruit"),
        ([HEAD, "a,0,20,thread"], "line 2: '0' is not the number of a fruit"),
        ([HEAD, "a,1.5,20,thread"], "line 2: '1.5' is not the number of a fruit"),
        ([HEAD, ",1,20,thread"], "line 2: names no capture"),
        (
            [HEAD, "a,1,20,thread", "b,1,9,thread", "a,1,21,thread"],
            "lines 2 and 4 contradict each other: 20 cm and 21 cm for fruit 1 of 'a'",
        ),
        (
            [HEAD + ",specimen", "a,1,20,thread,s1", "a,2,21,thread,s1"],
            "lines 2 and 3: specimen 's1' is fruit 1 and 2 of 'a'",
        ),
        (
            [HEAD + ",specimen,repeat", "a,1,20,thread,s1,1", "a,1,20,thread,s2,2"],
            "call one fruit 's1' and 's2'",
        ),
    ],
)
def test_bad_truth_is_refused_with_file_line_and_remedy(
    tmp_path: Path, lines: list[str], text: str
) -> None:
    path = write(tmp_path, *lines)
    with pytest.raises(TruthError, match=text) as caught:
        read_truth(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


COMMAS = "Capture,fruit,length_cm\r\nreihe-ä,1,23.5\r\n"
SEMICOLONS = "Capture;fruit;length_cm\r\nreihe-ä;1;23,5\r\n"


@pytest.mark.parametrize("text", [COMMAS, SEMICOLONS, COMMAS.replace(",", "\t")])
@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_whatever_a_spreadsheet_writes(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(code))
    columns, lines = read_table(path)
    assert columns == ["capture", "fruit", "length_cm"]
    assert list(lines) == [2]
    assert lines[2]["capture"] == "reihe-ä"
    assert parse_number(lines[2]["length_cm"]) == 23.5


def test_excels_separator_line_and_blank_lines_are_counted_but_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("sep=;\na;b\n\n;\n1;2\n")
    assert read_table(path) == (["a", "b"], {5: {"a": "1", "b": "2"}})


def test_a_guarded_text_loses_its_apostrophe(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("a,b\n'=x,'plain\n")
    assert read_table(path)[1] == {2: {"a": "=x", "b": "'plain"}}


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
