from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from cucumbervision.accuracy.statistics import Cell, ReportTable
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_lab.evaluate.benchmark_report import (
    accuracy_table,
    comparable_readings,
    group_tables,
)
from cucumbervision_lab.evaluate.measure_case import LengthRecord, readings_frame

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.lab.evaluate.conftest import MakeRecord


def methods_against(records: Sequence[LengthRecord], truth: LengthDefinition) -> list[str]:
    return list(comparable_readings(readings_frame(records), truth)["method"].cat.categories)


def cell(table: ReportTable, row: str, head: str) -> Cell:
    place = [column.head for column in table.columns].index(head)
    return next(line[place] for line in table.rows if line[0] == row)


def test_each_method_is_compared_with_what_it_measures(make_record: MakeRecord) -> None:
    names = ["M6 chord", "M6 thread", "M6", "M5", "new tool", "skan", "M1"]
    records = [make_record(lengths_m=dict.fromkeys(names, 0.2))]
    assert methods_against(records, LengthDefinition.CENTRELINE) == [
        *("M1", "M5", "M6", "skan", "new tool")
    ]
    assert methods_against(records, LengthDefinition.THREAD) == [
        *("M1", "M5", "M6", "M6 thread", "skan", "new tool")
    ]
    assert methods_against(records, LengthDefinition.CHORD) == [
        *("M1", "M5", "M6 chord", "skan", "new tool")
    ]


def test_accuracy_by_hand(make_record: MakeRecord) -> None:
    # M1 errs +1 cm (5 %), -3 cm (15 %) and refuses once (20 cm, 100 %): MAE 24 / 3, MAPE 40,
    # median 15, worst 100, RMSE sqrt((1 + 9 + 400) / 3), bias (5 - 15) / 2, measured 2 of 3.
    lengths = [0.21, 0.17, None]
    records = [
        make_record(f"c{k}", fruit="one" if k < 2 else "two", lengths_m={"M1": x})
        for k, x in enumerate(lengths)
    ]
    table = accuracy_table(readings_frame(records), LengthDefinition.CENTRELINE)
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
    assert cell(table, "M1", "95 % by fruit (%)") == "10.00 to 100.00"
    # By capture the mean of three draws of 5, 15, 100; all 5 has 1/27 = 3.7 %, above the tail.
    assert cell(table, "M1", "95 % by capture (%)") == "5.00 to 100.00"


def tables_of(records: Sequence[LengthRecord], truth: LengthDefinition) -> list[ReportTable]:
    return group_tables(comparable_readings(readings_frame(records), truth), truth)


def test_bounds_belong_to_the_upper_group_and_the_last_is_closed(make_record: MakeRecord) -> None:
    tilts = [0, 14.9, -15, 30, 45, 60, 61]
    records = [make_record(f"c{t}", tilt_deg=float(t), lengths_m={"M1": 0.2}) for t in tilts]
    (table,) = tables_of(records, LengthDefinition.CENTRELINE)
    assert {row[0]: row[1] for row in table.rows} == {
        "0 to 15": 2,
        "15 to 30": 1,
        "30 to 45": 1,
        "45 to 60": 2,
        "above 60": 1,
    }


def test_groups_by_hand(make_record: MakeRecord) -> None:
    # Straight: M6 errs 1 and 3 %, M1 refuses once and is right once. Bent: 10 and 20 %.
    records = [
        make_record("a", lengths_m={"M1": None, "M6": 0.202}),
        make_record("b", lengths_m={"M1": 0.2, "M6": 0.194}),
        make_record("c", bend_radius_m=0.3, lengths_m={"M1": 0.16, "M6": 0.18}),
    ]
    (table,) = tables_of(records, LengthDefinition.CENTRELINE)
    assert table.columns[0].head == "radius of the bend (cm)"
    assert [column.head for column in table.columns[3:]] == [
        *("M1 MAPE (%)", "M6 MAPE (%)", "M6 median (%)", "M6 worst (%)", "M6 measured (%)")
    ]
    straight, bent = table.rows
    assert straight[:3] == ("straight", 2, 2)
    assert straight[3:] == pytest.approx((50.0, 2.0, 2.0, 3.0, 100.0))
    assert bent[0] == "30 and more"
    assert bent[3:] == pytest.approx((20.0, 10.0, 10.0, 10.0, 100.0))


def test_fruit_that_m6_flags_are_a_group_of_their_own(make_record: MakeRecord) -> None:
    flags: list[list[str] | None] = [[], [], ["end-hidden"], None]
    records = [
        make_record(
            f"c{k}",
            details={} if some is None else {"m6_flags": some},
            lengths_m={"M6": None if some is None else 0.2},
        )
        for k, some in enumerate(flags)
    ]
    (table,) = tables_of(records, LengthDefinition.CENTRELINE)
    assert table.columns[0].head == "M6's flags"
    assert [row[:2] for row in table.rows] == [("none", 2), ("some, or not measured", 2)]
