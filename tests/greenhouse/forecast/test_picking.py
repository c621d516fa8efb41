from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.forecast import Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import FruitState, GrowthPrior, Spreads, fit_growth
from cucumbervision_greenhouse.forecast.picking import (
    PickKind,
    Rates,
    pick_list,
    plan_work,
    ready_on,
)

LONG = load_profile("long-cucumber")
FRUIT = [
    FruitState("a", "10", 1.0, 0.30, 0.003),
    FruitState("b", "2", 5.0, 0.30, 0.003, side="left"),
    FruitState("c", "2", 2.0, 0.26, 0.003, side="right"),
    FruitState("d", "2", 3.0, 0.20, 0.003),
    FruitState("e", "10", 4.0, 0.38, 0.003),
    FruitState("f", "10", 2.0, 0.25, 0.01),
]


def found(fruit: list[FruitState]) -> Forecast:
    return forecast(fruit, fit_growth([], GrowthPrior.of(LONG)), LONG)


def test_list_is_in_walking_order_with_fruit_too_long_in_it() -> None:
    picks = pick_list(found(FRUIT))
    assert [(p.fruit.fruit_id, p.name, p.kind) for p in picks] == [
        ("c", "I", PickKind.READY),
        ("b", "I", PickKind.READY),
        ("e", "too long", PickKind.TOO_LONG),
        ("f", "undecided", PickKind.UNDECIDED),
        ("a", "I", PickKind.READY),
    ]
    assert picks[3].possible == ("II", "I")
    assert 0.35 < picks[3].ready < 0.65


def test_what_is_ready_is_the_sum_of_the_probabilities_on_each_day() -> None:
    today = found(FRUIT)
    ready = ready_on(today)
    assert ready.fruit == pytest.approx(today.ready().sum())
    assert (ready.sure, ready.may_be, ready.too_long) == (3, 1, 1)
    assert 3.3 < ready.fruit < 3.7
    assert plan_work(today)[0].fruit.expected == pytest.approx(ready.fruit)
    rows = [ready_on(today, row=row) for row in today.rows]
    assert sum(row.fruit for row in rows) == pytest.approx(ready.fruit)
    left = ready_on(today, picked={"a", "f"})
    assert (left.sure, left.may_be) == (2, 0)
    for day in range(8):
        later = ready_on(today, day)
        assert later.expected["I"] == pytest.approx(today.house.expected[day, 0])
        assert later.sure <= later.fruit + 0.05 * len(FRUIT)
        assert later.fruit <= later.sure + later.may_be + 0.05 * len(FRUIT)


def test_what_a_grade_decided_stands_on_its_day_and_grows_afterwards() -> None:
    state = FruitState("a", "1", 0.0, 0.24, 0.02, possible=("II",))
    bound = replace(state, fruit_id="b", possible=("II", "I", "too long"), at_least=True)
    growth = fit_growth([], replace(GrowthPrior.of(LONG), full_m=(np.inf,)))
    assert forecast([state, bound], growth, LONG).possible == (state.possible, bound.possible)
    later = forecast([replace(state, sd_m=0.003), bound], growth, LONG, today=2.0)
    # About 30 cm, by the profile's growth.
    assert later.possible == (("I",), ("I", "too long"))


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
