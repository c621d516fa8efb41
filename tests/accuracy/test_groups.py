from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from cucumbervision.accuracy.groups import (
    coverage_rows,
    coverage_table,
    factors_of,
    group_table,
)
from cucumbervision.accuracy.tables import Truth

if TYPE_CHECKING:
    from tests.accuracy.conftest import MakeRecord


def test_bounds_belong_to_the_upper_group_and_the_last_is_closed(make_record: MakeRecord) -> None:
    tilts = [0, 14.9, -15, 30, 45, 60, 61]
    records = [make_record(f"c{t}", tilt_deg=float(t), lengths_m={"M1": 0.2}) for t in tilts]
    (factor,) = factors_of(records)
    table = group_table(records, factor, Truth.CENTRELINE)
    assert table is not None
    assert {row[0]: row[1] for row in table.rows} == {
        "0 to 15": 2,
        "15 to 30": 1,
        "30 to 45": 1,
        "45 to 60": 2,
        "above 60": 1,
        "30 to 60, together": 3,
    }


def test_groups_by_hand(make_record: MakeRecord) -> None:
    # Straight: M6 errs 1 and 3 %, M1 refuses once and is right once. Bent: 10 and 20 %.
    records = [
        make_record("a", lengths_m={"M1": None, "M6": 0.202}),
        make_record("b", lengths_m={"M1": 0.2, "M6": 0.194}),
        make_record("c", bend_radius_m=0.3, lengths_m={"M1": 0.16, "M6": 0.18}),
    ]
    (factor,) = factors_of(records)
    assert factor.head == "radius of the bend (cm)"
    table = group_table(records, factor, Truth.CENTRELINE)
    assert table is not None
    assert [column.head for column in table.columns[3:]] == [
        *("M1 MAPE (%)", "M6 MAPE (%)", "M6 median (%)", "M6 worst (%)", "M6 measured (%)")
    ]
    straight, bent = table.rows
    assert straight[:3] == ("straight", 2, 2)
    assert straight[3:] == pytest.approx((50.0, 2.0, 2.0, 3.0, 100.0))
    assert bent[0] == "30 and more"
    assert bent[3:] == pytest.approx((20.0, 10.0, 10.0, 10.0, 100.0))


def test_sizes_go_by_the_truth_of_the_table(make_record: MakeRecord) -> None:
    # 9.8 cm along the axis and 10.4 by thread: small by the one, medium by the other.
    records = [
        make_record("a", centreline_m=0.098, thread_m=0.104, lengths_m={"M1": 0.1}),
        make_record("b", lengths_m={"M1": 0.2}),
    ]
    factor = factors_of(records)[0]
    tables = [group_table(records, factor, truth) for truth in (Truth.CENTRELINE, Truth.THREAD)]
    assert [table and table.rows[0][0] for table in tables] == [
        *("small: below 10", "medium: 10 to 18")
    ]


def test_unknown_values_are_in_no_group(make_record: MakeRecord) -> None:
    nan = float("nan")
    records = [make_record(c, hidden_share=nan, tilt_deg=nan, distance_m=nan) for c in "ab"]
    assert factors_of(records) == []


def test_both_ends_in_sight_is_a_group_of_its_own(make_record: MakeRecord) -> None:
    records = [
        make_record(
            f"c{k}", hidden_share=0.1 * k, details={"ends_seen": k < 4}, lengths_m={"M6": 0.2}
        )
        for k in range(6)
    ]
    every, seen = factors_of(records)
    counts = [
        {row[0]: row[1] for row in table.rows}
        for factor in (every, seen)
        if (table := group_table(records, factor, Truth.CENTRELINE))
    ]
    assert counts == [
        {"0": 1, "above 0 to 20": 1, "20 to 40": 2, "40 to 60": 2},
        {"0": 1, "above 0 to 20": 1, "20 to 40": 2},
    ]


def test_coverage_by_hand(make_record: MakeRecord) -> None:
    # 8 of 10 intervals of +-1 cm around 20 cm hold the truth: width 10 %. Exact binomial interval
    # of 8 of 10: 44.4 to 97.5 % (Clopper and Pearson 1934), which contains 90.
    def details(middle_m: float) -> dict[str, float]:
        return {"interval_low_m": middle_m - 0.01, "interval_high_m": middle_m + 0.01}

    records = [
        make_record(f"c{k}", condition="sun" if k < 2 else "plain", details=details(m))
        for k, m in enumerate([0.22, 0.18, *[0.2] * 8])
    ]
    everything, sun, plain = coverage_rows(records)
    assert (everything.count, everything.hits, everything.as_stated) == (10, 8, True)
    assert (everything.low, everything.high) == pytest.approx((0.444, 0.975), abs=5e-4)
    assert plain.width_percent == pytest.approx(10.0)
    # None of two: the upper limit is 1 - 0.025^(1/2) = 84.2 %, which is below 90.
    assert (sun.group, sun.hits, sun.as_stated) == ("sun", 0, False)
    assert sun.high == pytest.approx(1 - 0.025**0.5)
    assert coverage_table([sun]).rows[0][:5] == ("condition", "sun", 2, 2, 0.0)


@pytest.mark.parametrize(
    ("hits", "as_stated"), [(348, True), (347, False), (372, True), (373, False)]
)
def test_large_groups_have_fixed_bounds(
    make_record: MakeRecord, hits: int, as_stated: bool
) -> None:
    # 87 % of 400 are 348, 93 % are 372.
    records = [
        make_record(
            f"c{k}",
            details={"interval_low_m": 0.1, "interval_high_m": 0.3 if k < hits else 0.15},
        )
        for k in range(400)
    ]
    assert coverage_rows(records)[0].as_stated is as_stated


def test_each_length_has_its_own_interval(make_record: MakeRecord) -> None:
    records = [make_record(details={"thread_interval_low_m": 0.21, "thread_interval_high_m": 0.23})]
    assert coverage_rows(records) == []
    assert coverage_rows(records, truth=Truth.THREAD)[0].hits == 1


def test_a_basis_is_a_group(make_record: MakeRecord) -> None:
    ends = {"interval_low_m": 0.1, "interval_high_m": 0.3}
    records = [
        make_record("a", details={**ends, "interval_basis": "simulated"}),
        make_record("b", details={**ends, "interval_basis": "own truth"}),
    ]
    assert [row.group for row in coverage_rows(records)] == ["all", "simulated", "own truth"]
