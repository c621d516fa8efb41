from __future__ import annotations

import math

import pytest

from cucumbervision.accuracy.statistics import ReportColumn, ReportTable


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (1.005, "1.00"),  # 1.005 is a little less in binary
        (-1.5, "−1.50"),
        (12, "12"),
        ("M1", "M1"),
        (True, "yes"),
        (False, "no"),
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "–"),
    ],
)
def test_a_cell_as_text(cell: float | str | None, text: str) -> None:
    assert ReportColumn("a").show(cell) == text


def test_json_keeps_every_digit_and_text_does_not() -> None:
    table = ReportTable.of("t", ["a:.1"], [[1 / 3]])
    assert table.as_json()["rows"][0]["a"] == 1 / 3
    assert table.text_rows() == [["0.3"]]
