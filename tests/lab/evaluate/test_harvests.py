from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from cucumbervision.accuracy.statistics import ReportTable
from cucumbervision.errors import DataSetError
from cucumbervision_lab.evaluate.harvests import (
    harvest_tables,
    picks_table,
    read_compartment,
    ripening_table,
)


def write(folder: Path, name: str, pace: float) -> Path:
    """Three months of the same picks each day but Sunday, of fruit that take longer and longer."""
    dates = pd.date_range("2018-08-14", periods=90)
    daily = pd.DataFrame({"date": dates, "class_a_fruit_per_m2": pace * (dates.day_of_week < 6)})
    daily["class_b_fruit_per_m2"] = 0.0
    daily["air_mean_c"] = 22 - np.arange(90) / 30
    daily["outside_radiation_mj_per_m2"] = 10.0
    daily.to_csv(folder / f"{name}_daily.csv", index=False)
    weeks = sorted(set(dates.isocalendar().week))[3:]
    took = [None, *(np.exp(2 + 0.05 * k) for k in range(len(weeks) - 1))]
    weekly = pd.DataFrame({"iso_week": weeks, "days_from_flower_to_harvest": took})
    weekly.to_csv(folder / f"{name}_weekly.csv", index=False)
    return folder / f"{name}_daily.csv"


def rows_of(table: ReportTable) -> dict[tuple[Any, ...], tuple[Any, ...]]:
    return {row[:2]: row for row in table.rows}


def test_steady_picks_are_forecast_by_the_own_rate(tmp_path: Path) -> None:
    houses = [
        read_compartment(write(tmp_path, name, pace))
        for name, pace in zip("abc", (1, 2, 4), strict=True)
    ]
    rows = rows_of(picks_table(houses))
    assert rows[3, "own rate since the first pick"][2:6] == pytest.approx((0, 0, 0, 0), abs=1e-9)
    # A week's rate of 6 in 7 is wrong on each single day.
    assert rows[1, "last week's rate"][2] > 10
    assert rows[7, "last week's rate"][2] == pytest.approx(0, abs=1e-9)
    constant, known, _ = (float(str(row[1])) for row in ripening_table(houses).rows)
    assert known < 0.5 * constant


def test_what_cannot_be_compared_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, "a", 1)
    with pytest.raises(DataSetError, match="holds 1 compartments"):
        harvest_tables(tmp_path)
    path.write_text("date,kg\n2018-08-14,1\n")
    with pytest.raises(DataSetError, match=r"a_daily\.csv"):
        read_compartment(path)


@pytest.mark.realdata
def test_real_harvests_are_within_the_aims(shared_data: Path) -> None:
    houses = [read_compartment(p) for p in sorted((shared_data / "harvest").glob("*_daily.csv"))]
    rows = rows_of(picks_table(houses))
    for days, percent in ((3, 29.7), (7, 19.8)):
        assert rows[days, "own rate since the first pick"][2] == pytest.approx(percent, abs=0.05)
    errors = [row[1] for row in ripening_table(houses).rows]
    # Climate up to the flower is no better than a constant: only what comes later decides.
    assert errors == pytest.approx([2.21, 1.00, 2.32], abs=0.01)
