from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.forecast import DetectionRates, Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import GrowthPrior, Link, Spreads, fit_growth
from cucumbervision_greenhouse.forecast.length_draws import FruitState

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


def test_missed_and_invented_fruit_move_the_count() -> None:
    fruit = fruit_of(0.30, 500)
    half = steadily(fruit, detection=DetectionRates(found=0.5)).house
    assert half.expected[0, 0] == pytest.approx(1000, rel=0.01)
    # Negative binomial: variance n (1 - q) / q^2 = 1000.
    assert half.high[0, 0] - half.low[0, 0] == pytest.approx(2 * 1.2816 * 1000**0.5, rel=0.12)
    fewer = steadily(fruit, detection=DetectionRates(false=0.1)).house
    assert fewer.expected[0, 0] == pytest.approx(450, rel=0.01)
    # What is invented hides no missed fruit: 500 (1 - 0.4) / 0.5.
    both = steadily(fruit, detection=DetectionRates(found=0.5, false=0.4), draws=2000).house
    assert both.expected[0, 0] == pytest.approx(600, rel=0.01)


def test_own_links_tell_fast_fruit_from_slow() -> None:
    now = [FruitState(f, "1", 0.0, 0.20, 0.002, day=2) for f in ("fast", "slow", "unknown")]
    links = [
        Link("fast", "1", 0, 0.12, 0.002, 2, 0.20, 0.002),
        Link("slow", "1", 0, 0.16, 0.002, 2, 0.20, 0.002),
    ]
    found = forecast(now, fit_growth(links, PRIOR), LONG)
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


def test_picked_fruit_leave_the_forecast() -> None:
    fruit = fruit_of(0.30, 3)
    left = steadily([replace(one, picked=one.fruit_id == "1-1") for one in fruit])
    assert [f.fruit_id for f in left.fruit] == ["1-0", "1-2"]
    assert left.house.expected[0, 0] == 2


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


def test_same_seed_same_forecast() -> None:
    fruit = fruit_of(0.23, 20, 0.004)
    one, two, three = (forecast(fruit, UNSEEN, LONG, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.probability, two.probability)
    assert (one.probability != three.probability).any()


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
    assert found.ready.shape == (0,)


def test_three_thousand_fruit_take_less_than_a_second_of_a_core() -> None:
    lengths = np.random.default_rng(0).uniform(0.05, 0.35, 3000)
    rows = [str(k % 20) for k in range(3000)]
    links = [
        Link(str(k), rows[k], 0, max(lengths[k] - 0.06, 0.01), 0.005, 2, lengths[k], 0.005)
        for k in range(500)
    ]
    fruit = [FruitState(str(k), rows[k], 0.1 * k, lengths[k], 0.005, 2) for k in range(3000)]
    growth = fit_growth(links, PRIOR)
    spent = []
    for _ in range(2):
        start = time.process_time()
        forecast(fruit, growth, LONG)
        spent.append(time.process_time() - start)
    assert min(spent) < 1.0
