from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.errors import DataSetError
from cucumbervision_lab.processes import kept_rows


def rows_of(number: int) -> list[dict[str, int]]:
    return [{"number": number}, {"number": -number}]


def test_an_interrupted_run_goes_on_and_finished_jobs_are_not_done_again(tmp_path: Path) -> None:
    file, done = tmp_path / "new" / "rows.jsonl", list[int]()
    kept_rows(file, {"a": 1, "b": 2}, rows_of)
    file.write_text(file.read_text() + '{"picture": "c", "fru')
    both = kept_rows(file, {"c": 3, "a": 9}, rows_of, workers=2, progress=done.append)
    assert both == [*rows_of(3), *rows_of(1)]
    assert done == [1, 1]
    assert len(file.read_text().splitlines()) == 3


def test_a_damaged_line_is_named(tmp_path: Path) -> None:
    file = tmp_path / "rows.jsonl"
    file.write_text("nonsense\n")
    with pytest.raises(DataSetError, match=r"rows\.jsonl, line 1: is damaged"):
        kept_rows(file, {"a": 1}, rows_of)
