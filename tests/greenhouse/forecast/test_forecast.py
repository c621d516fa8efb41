from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from cucumbervision.crop.grades import NO_CLASS
from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.forecast import Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import FruitState, GrowthPrior, Spreads, fit_growth
from cucumbervision_lab.evaluate.harvests import Scenario, run_house

LONG = load_profile("long-cucumber")
PRIOR = replace(GrowthPrior.of(LONG), full_m=(np.inf,))
UNSEEN = fit_growth([], PRIOR)
TINY = 1e-9
# Growth of exactly 3 cm a day, but for what a test makes uncertain.
STEADY = GrowthPrior(0.03, Spreads(TINY, TINY, TINY, TINY, TINY))


def fruit_of(
    length_m: float, count: int = 1, sd_m: float = 1e-6, row: str = "1"
) -> list[FruitState]:
    return [FruitState(f"{row}-{k}", row, 0.1 * k, length_m, sd_m) for k in range(count)]


def steadily(fruit: list[FruitState], **options: object) -> Forecast:
    return forecast(fruit, fit_growth([], STEADY), LONG, **options)  # type: ignore[arg-type]


def test_known_growth_gives_the_classes_by_hand() -> None:
    found = steadily(fruit_of(0.185))
    # 18.5, 21.5, 24.5, 27.5, 30.5, 33.5, 36.5, 39.5 cm
    names = [found.classes[k] for k in found.probability[0].argmax(axis=1)]
    assert names == ["too short", "II", "II", "I", "I", "I", "too long", "too long"]
    np.testing.assert_array_equal(found.probability.max(axis=2), 1.0)
    assert found.picks.expected[:, 0].tolist() == [0, 0, 0, 1, 0, 0, 0, 0]


def test_lengths_error_spreads_a_fruit_over_classes() -> None:
    found = steadily(fruit_of(0.25, sd_m=0.01), draws=2000)
    assert found.probability[0, 0, 0] == pytest.approx(0.5, abs=0.03)
    tomorrow = ndtr((0.28 - 0.25) / 0.01)
    assert found.probability[0, 1, 0] == pytest.approx(tomorrow, abs=0.01)


def test_independent_fruit_are_as_uncertain_as_the_binomial() -> None:
    counts = steadily(fruit_of(0.25, 400, sd_m=0.01), draws=2000).house
    width = counts.high[0, 0] - counts.low[0, 0]
    assert counts.expected[0, 0] == pytest.approx(200, abs=1.5)
    assert width == pytest.approx(2 * 1.2816 * 10, abs=2)


def test_shared_growth_makes_counts_more_uncertain_than_single_fruit() -> None:
    fruit = fruit_of(0.22, 400)
    shared = forecast(fruit, fit_growth([], replace(PRIOR, spreads=replace_house(0.01))), LONG)
    own = forecast(fruit, fit_growth([], replace(PRIOR, spreads=replace_fruit(0.01))), LONG)
    assert shared.probability[:, 1, 0].mean() == pytest.approx(0.5, abs=0.06)
    assert own.probability[:, 1, 0].mean() == pytest.approx(0.5, abs=0.06)
    wide = shared.house.high[1, 0] - shared.house.low[1, 0]
    narrow = own.house.high[1, 0] - own.house.low[1, 0]
    assert wide > 380  # all or none
    assert narrow < 60


def replace_house(house: float) -> Spreads:
    return Spreads(house, TINY, TINY, TINY, TINY)


def replace_fruit(fruit: float) -> Spreads:
    return Spreads(TINY, TINY, fruit, TINY, TINY)


def test_scale_error_is_shared_and_not_counted_twice() -> None:
    fruit = fruit_of(0.25, 400, sd_m=0.0025)
    alone = steadily(fruit).house
    shared = steadily(fruit, scale_sd=0.01).house
    assert alone.high[0, 0] - alone.low[0, 0] < 40
    assert shared.high[0, 0] - shared.low[0, 0] > 380
    mean = forecast(fruit, UNSEEN, LONG, scale_sd=0.01).probability[:, 0, 0].mean()
    assert mean == pytest.approx(0.5, abs=0.1)


def test_a_fruit_of_which_part_is_seen_resembles_those_that_are_longer() -> None:
    whole = fruit_of(0.22, 6) + fruit_of(0.30, 3, row="2")
    bound = FruitState("b", "3", 0.0, 0.10, 1e-6, at_least=True)
    unknown = replace(bound, fruit_id="u", length_m=0.0)
    long = replace(bound, fruit_id="l", length_m=0.25)
    found = steadily([*whole, bound, unknown, long], draws=3000)
    ready = {f.fruit_id: p for f, p in zip(found.fruit, found.ready().tolist(), strict=True)}
    assert (ready["b"], ready["u"]) == pytest.approx((1 / 3, 1 / 3), abs=0.03)
    assert ready["l"] == 1.0
    assert found.house.expected[0].sum() == len(whole) + 3


def test_a_fruit_that_no_class_allows_is_in_no_count() -> None:
    light = replace(fruit_of(0.30)[0], possible=(NO_CLASS,))
    found = steadily([light, *fruit_of(0.30, 2, row="2")])
    assert found.house.expected[0].tolist() == [2, 0, 0, 0]
    assert found.ready().tolist() == [0, 1, 1]


def test_own_links_tell_fast_fruit_from_slow() -> None:
    before = {"fast": ((0, 0.12, 0.002),), "slow": ((0, 0.16, 0.002),), "unknown": ()}
    now = [FruitState(f, "1", 0.0, 0.20, 0.002, 2, earlier=before[f]) for f in before]
    found = forecast(now, fit_growth(now, PRIOR), LONG)
    at = {f.fruit_id: p for f, p in zip(found.fruit, found.probability, strict=True)}
    ready = {name: float(p[2, 0]) for name, p in at.items()}
    assert ready["fast"] > ready["unknown"] > ready["slow"]
    assert ready["fast"] > 0.9


def test_fruit_seen_earlier_are_carried_on_to_today() -> None:
    old = FruitState("a", "1", 0.0, 0.24, 1e-6, day=3)
    found = steadily([old], today=5.0)
    # 24 cm and two days of 3 cm.
    assert found.probability[0, 0].tolist() == [1, 0, 0, 0]
    assert found.probability[0, 1].tolist() == [1, 0, 0, 0]
    assert found.probability[0, 2].tolist() == [0, 0, 0, 1]


def test_crooked_fruit_stay_in_the_class_their_shape_allows() -> None:
    bent = [replace(f, best_class="II") for f in fruit_of(0.235)]
    found = steadily(bent)
    assert found.house.expected[:5, 1].tolist() == [1, 1, 1, 1, 0]
    assert found.house.expected[:5, 0].sum() == 0
    assert found.picks.expected.sum() == 0


def test_picked_fruit_leave_the_counts_and_nothing_else_changes() -> None:
    fruit = fruit_of(0.25, 3, sd_m=0.01) + fruit_of(0.25, 1, sd_m=0.01, row="2")
    all_fruit = steadily(fruit)
    left = steadily([replace(x, picked=x.fruit_id in {"1-1", "2-0"}) for x in fruit])
    np.testing.assert_array_equal(left.probability, all_fruit.probability)
    assert left.house.expected[0].sum() == 2
    assert left.picks.expected[0, 0] == pytest.approx(left.ready()[[0, 2]].sum())


def test_rows_add_up_to_the_house_and_come_in_walking_order() -> None:
    fruit = fruit_of(0.24, 30, 0.005, "10") + fruit_of(0.22, 20, 0.005, "2")
    found = forecast(fruit, UNSEEN, LONG)
    assert found.rows == ("2", "10")
    np.testing.assert_allclose(found.by_row.expected.sum(axis=0), found.house.expected)
    np.testing.assert_allclose(found.house.expected.sum(axis=1), 50)
    np.testing.assert_allclose(found.probability.sum(axis=0), found.house.expected, rtol=1e-9)
    assert (found.house.low <= found.house.high).all()
    # Every fruit becomes ready once at most, unless it grows through all of class I in a day.
    assert found.picks.expected.sum() <= 50


def test_complete_says_how_far_the_fruit_seen_suffice() -> None:
    # From 5 cm at 3 cm a day: 20 cm on day 5, 26 cm on day 7, never beyond 35.
    found = steadily(fruit_of(0.30))
    assert found.complete[:, 0].tolist() == [True] * 7 + [False]
    assert found.complete[:, 1].tolist() == [True] * 5 + [False] * 3
    assert found.complete[:, 2].tolist() == [True] + [False] * 7
    assert found.complete[:, 3].all()


def test_empty_house_is_no_error() -> None:
    found = forecast([], UNSEEN, LONG)
    assert found.house.expected.sum() == 0
    assert found.rows == ()
    assert found.ready().shape == (0,)


@pytest.mark.parametrize("full_m", [math.inf, 0.45])
def test_intervals_hold_and_naive_growth_is_beaten(full_m: float) -> None:
    scenario = Scenario("50 links", 50, full_m=full_m)
    outcomes = [run_house(scenario, seed) for seed in range(10)]
    share, error, naive, picks, picks_error = np.mean(outcomes, axis=0)
    # 10 houses of about 12 dependent cells: the mean's standard error is some 5 %.
    assert 0.65 < share < 0.97
    assert error < 0.9 * naive
    assert picks_error < 0.2 * picks
