from __future__ import annotations

import pytest

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.forecast import forecast
from cucumbervision_greenhouse.forecast.growth import FruitState, GrowthPrior, Spreads, fit_growth
from cucumbervision_greenhouse.forecast.picking import Rates, plan_work

LONG = load_profile("long-cucumber")
STEADY = fit_growth([], GrowthPrior(0.03, Spreads(1e-9, 1e-9, 1e-9, 1e-9, 1e-9)))


def fruit_of(row: str, count: int, length_m: float) -> list[FruitState]:
    return [FruitState(f"{row}-{k}", row, 0.1 * k, length_m, 1e-6) for k in range(count)]


def test_hours_and_crates_by_hand() -> None:
    # Ready today: 60 in row 1. Tomorrow 25 of row 2 grow from 23 to 26 cm.
    found = forecast(fruit_of("1", 60, 0.28) + fruit_of("2", 25, 0.23), STEADY, LONG)
    plan = plan_work(found, Rates(fruit_per_hour=120, minutes_per_row=6, fruit_per_crate=12))
    assert [day.fruit.expected for day in plan] == [60, 25, 0, 0, 0, 0, 0, 0]
    assert plan[0].hours.expected == pytest.approx(60 / 120 + 0.1)
    assert plan[1].hours.expected == pytest.approx(25 / 120 + 0.1)
    assert plan[2].hours.expected == 0
    assert [day.crates["I"].expected for day in plan[:3]] == [5, 3, 0]
    assert [day.complete for day in plan] == [True] * 7 + [False]


def test_each_class_has_crates_of_its_own() -> None:
    profile = LONG.model_copy(update={"pick": ("I", "II")})
    found = forecast(fruit_of("1", 30, 0.28) + fruit_of("2", 20, 0.22), STEADY, profile)
    crates = plan_work(found, Rates(fruit_per_crate=12))[0].crates
    assert (crates["I"].expected, crates["II"].expected) == (3, 2)
