from __future__ import annotations

import math
from pathlib import Path

import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision_lab.evaluate.measure_case import (
    LengthRecord,
    Masks,
    append_record,
    read_records,
    readings_frame,
)

ONE = LengthRecord(
    "a", "stress", Masks.DISTURBED, "f1", 0.2, None, 0.19, 0.5, 12.0, 0.3, 0.1, 0.97,
    lengths_m={"M1": None, "M6": 0.2}, details={"flags": ["cut-by-frame"]},
)  # fmt: skip


def test_a_record_reads_back_the_same(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    append_record(path, ONE)
    append_record(path, ONE)
    assert read_records([path]) == [ONE, ONE]


def test_an_unfinished_last_line_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    append_record(path, ONE)
    with path.open("a") as stream:
        stream.write('{"case": "b", "sui')
    assert read_records([path]) == [ONE]


def test_a_broken_line_in_the_middle_is_named(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    path.write_text("nonsense\n")
    append_record(path, ONE)
    with pytest.raises(CucumberVisionError, match=r"records\.jsonl, line 1: is damaged"):
        read_records([path])


def test_a_row_is_a_record_and_a_method() -> None:
    frame = readings_frame([ONE])
    assert frame["method"].tolist() == ["M1", "M6"]
    assert math.isnan(frame["length_m"][0])
    assert frame["length_m"][1] == 0.2
    # What is not known is NaN, whatever the column; details are columns of their own.
    assert frame["thread_m"].isna().all()
    assert frame["thread_m"].dtype == float
    assert frame["flags"].tolist() == [["cut-by-frame"]] * 2
