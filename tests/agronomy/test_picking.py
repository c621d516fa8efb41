from __future__ import annotations

from dataclasses import replace

from cucumbervision.agronomy.forecast import Forecast, FruitState, forecast
from cucumbervision.agronomy.growth import GrowthPrior, fit_growth
from cucumbervision.agronomy.picking import pick_list
from cucumbervision.agronomy.profiles import load_profile

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
    picks = pick_list(found(FRUIT), 0.8)
    assert [(p.fruit.fruit_id, p.name) for p in picks] == [
        ("c", "I"),
        ("b", "I"),
        ("e", "too long"),
        ("a", "I"),
    ]


def test_threshold_decides_on_uncertain_fruit() -> None:
    listed = {p.fruit.fruit_id: p.ready for p in pick_list(found(FRUIT), 0.2)}
    assert 0.35 < listed["f"] < 0.65


def test_picked_fruit_are_not_listed_again() -> None:
    left = [replace(one, picked=one.fruit_id in {"b", "e"}) for one in FRUIT]
    assert [p.fruit.fruit_id for p in pick_list(found(left), 0.8)] == ["c", "a"]
