from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.accuracy.tables import (
    Truth,
    accuracy_table,
    comparison_table,
    method_rows,
    methods_against,
    validation_table,
)

if TYPE_CHECKING:
    from tests.accuracy.conftest import MakeRecord


def cell(table: Table, row: str, head: str) -> Cell:
    place = [column.head for column in table.columns].index(head)
    return next(line[place] for line in table.rows if line[0] == row)


def test_each_method_is_held_against_what_it_measures(make_record: MakeRecord) -> None:
    names = ["oracle", "M6 chord", "M6 thread", "M6", "M5", "new tool", "rectangle", "M1"]
    records = [make_record(lengths_m=dict.fromkeys(names, 0.2))]
    assert methods_against(records, Truth.CENTRELINE) == [
        *("M1", "M5", "M6", "rectangle", "new tool", "oracle")
    ]
    assert methods_against(records, Truth.THREAD) == [
        *("M1", "M5", "M6", "M6 thread", "rectangle", "new tool")
    ]
    assert methods_against(records, Truth.CHORD) == [
        *("M1", "M5", "M6 chord", "rectangle", "new tool")
    ]


def test_what_was_reported_counts_only_by_its_own_kind(make_record: MakeRecord) -> None:
    said = {"reported_kind": "thread"}
    records = [make_record(lengths_m={"reported": 0.22}, details=said)]
    assert methods_against(records, Truth.THREAD) == ["reported"]
    assert methods_against(records, Truth.CENTRELINE) == []
    raw = [make_record(lengths_m={"reported": 0.22}, details={"reported_kind": "surface-arc"})]
    assert methods_against(raw, Truth.CENTRELINE) == ["reported"]


def test_accuracy_by_hand(make_record: MakeRecord) -> None:
    # M1 errs +1 cm (5 %), -3 cm (15 %) and refuses once (20 cm, 100 %): MAE 24 / 3, MAPE 40,
    # median 15, worst 100, RMSE sqrt((1 + 9 + 400) / 3), bias (5 - 15) / 2, measured 2 of 3.
    lengths = [0.21, 0.17, None]
    records = [
        make_record(f"c{k}", fruit="one" if k < 2 else "two", lengths_m={"M1": x})
        for k, x in enumerate(lengths)
    ]
    rows = method_rows(records, Truth.CENTRELINE)
    table = accuracy_table(rows, Truth.CENTRELINE)
    assert cell(table, "M1", "captures") == 3
    assert cell(table, "M1", "fruit") == 2
    for head, value in {
        "measured (%)": 200 / 3,
        "MAE (cm)": 8.0,
        "MAPE (%)": 40.0,
        "RMSE (cm)": (410 / 3) ** 0.5,
        "median error (%)": 15.0,
        "worst error (%)": 100.0,
        "bias (%)": -5.0,
    }.items():
        assert cell(table, "M1", head) == pytest.approx(value), head
    # By fruit there are but three resamples: one twice (10 %), two twice (100 %), and both. Each
    # of the first two has a quarter of the chance, so the interval reaches from 10 to 100.
    assert rows[0].by_fruit == pytest.approx((10.0, 100.0))
    # By capture the mean of three draws of 5, 15, 100; all 5 has 1/27 = 3.7 %, above the tail.
    assert rows[0].by_capture == pytest.approx((5.0, 100.0))


def test_a_method_that_was_not_run_is_not_punished(make_record: MakeRecord) -> None:
    records = [
        make_record("a", lengths_m={"M1": 0.2, "skan": 0.19}),
        make_record("b", lengths_m={"M1": 0.2}),
    ]
    table = accuracy_table(method_rows(records, Truth.CENTRELINE), Truth.CENTRELINE)
    assert cell(table, "skan", "captures") == 1
    assert cell(table, "skan", "MAPE (%)") == pytest.approx(5.0)


def test_the_best_but_for_the_oracle_is_bold(make_record: MakeRecord) -> None:
    records = [make_record(lengths_m={"M1": 0.19, "M6": 0.199, "oracle": 0.2})]
    table = accuracy_table(method_rows(records, Truth.CENTRELINE), Truth.CENTRELINE)
    heads = [column.head for column in table.columns]
    assert {table.rows[row][0] for row, _ in table.bold} == {"M6"}
    assert {heads[column] for _, column in table.bold} == {
        *("MAE (cm)", "RMSE (cm)", "MAPE (%)", "median error (%)", "worst error (%)")
    }


def test_comparisons_as_in_the_paper(make_record: MakeRecord) -> None:
    # M5 errs by 1.0, 1.1, … cm, everybody else by exactly 1 cm more: all ten differences have one
    # sign, so that p = 2 / 2^10 = 0.00195, below 0.05 / 4.
    records = [
        make_record(
            f"c{k}",
            fruit=f"f{k % 5}",
            lengths_m={
                "M5": 0.19 - 0.001 * k,
                **dict.fromkeys(("M1", "M2", "M3", "M4"), 0.18 - 0.001 * k),
            },
        )
        for k in range(10)
    ]
    table = comparison_table(records, Truth.CENTRELINE)
    assert table is not None
    assert [row[1] for row in table.rows] == ["M1", "M2", "M3", "M4"]
    assert cell(table, "M5", "median difference (cm)") == pytest.approx(-1.0)
    assert cell(table, "M5", "level (0.05 / tests)") == 0.0125
    assert cell(table, "M5", "p") == "0.0020"
    assert cell(table, "M5", "differ") is True
    # Five fruit, one sign: 2 / 2^5.
    assert cell(table, "M5", "p by fruit") == "0.0625"


def test_m6_is_tested_by_the_kind_it_reads(make_record: MakeRecord) -> None:
    lengths = {"M6": 0.2, "M6 thread": 0.22, "M1": 0.1, "oracle": 0.2}
    records = [make_record(f"c{k}", lengths_m=lengths) for k in range(6)]
    thread = comparison_table(records, Truth.THREAD)
    assert thread is not None
    assert [row[:2] for row in thread.rows] == [("M6 thread", "M1")]
    assert comparison_table(records[:4], Truth.THREAD) is None


def test_validation_reads_as_in_the_paper(make_record: MakeRecord) -> None:
    records = [
        make_record("v1", lengths_m={"M1": 0.2011, "M5": None}),
        make_record("v2", fruit="Cu-2", centreline_m=0.1, lengths_m={"M1": 0.095, "M5": 0.1}),
    ]
    table = validation_table(records, Truth.CENTRELINE)
    assert table.text_rows()[:2] == [
        ["v1", "20.00", "20.11 (+0.11)", "not measured"],
        ["Cu-2 (v2)", "10.00", "9.50 (−0.50)", "10.00 (+0.00)"],
    ]
    assert cell(table, "MAE (cm)", "M1 (cm)") == pytest.approx((0.11 + 0.5) / 2)
    assert cell(table, "MAPE (%)", "M5 (cm)") == pytest.approx(50.0)
