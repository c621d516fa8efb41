from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.simulated_houses import HouseSettings, simulate_house

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.growth import Growth, GrowthPrior, Link, Spreads, fit_growth

SPREADS = Spreads(0.008, 0.002, 0.005, 0.003, 0.003)
PRIOR = GrowthPrior.of(load_profile("long-cucumber"))


def house_sd(growth: Growth) -> float:
    """Return the standard deviation of the house's growth from today on."""
    return math.hypot(growth.lasting * growth.pace_sd_m, growth.lasting_sd_m)


def test_one_fruit_by_hand() -> None:
    # 10 cm in 2 days: 5 cm a day, whose variance is that of both lengths and of two days over 2²,
    # of its row and of itself.
    link = Link("a", "1", 0, 0.15, 0.004, 2, 0.25, 0.003)
    growth = fit_growth([link], PRIOR)
    error = (0.004**2 + 2 * (0.003**2 + 0.003**2) + 0.003**2) / 2**2 + 0.005**2 + 0.002**2
    weather = 0.003**2 / 2
    total = 0.008**2 + weather
    share = total / (total + error)
    assert growth.pace_m == pytest.approx(0.03 + share * (0.05 - 0.03))
    assert growth.pace_sd_m == pytest.approx(math.sqrt(share * error))
    # Of the deviation the house keeps its own share, and loses the weather's.
    kept = 0.008**2 / total
    assert growth.mean_m == pytest.approx(0.03 + kept * share * 0.02)
    assert growth.lasting_sd_m == pytest.approx(math.sqrt(0.008**2 * (1 - kept)))
    # A single fruit says nothing of the difference between fruit.
    assert growth.fruit_sd_m == pytest.approx(0.005)


def test_fruit_of_several_rows_by_hand() -> None:
    growths = {"a": ("1", 0.030), "b": ("1", 0.034), "c": ("2", 0.050)}
    links = [
        Link(name, row, 0, 0.15, 1e-6, 2, 0.15 + 2 * pace, 1e-6)
        for name, (row, pace) in growths.items()
    ]
    spreads = replace(SPREADS, day=1e-9, fruit_day=1e-9, row=0.004)
    growth = fit_growth(links, replace(PRIOR, spreads=spreads))
    # Row 1 scatters by 2 mm either way with one degree of freedom, the profile counts for four.
    variance = (4 * 0.005**2 + 2 * 0.002**2) / (4 + 1)
    assert growth.fruit_sd_m == pytest.approx(math.sqrt(variance), rel=1e-5)
    weights = 1 / (0.004**2 + variance / np.array([2, 1]))
    assert growth.rows["1"] == pytest.approx((0.032, 0.004**2 * weights[0]), rel=1e-5)
    assert growth.rows["2"] == pytest.approx((0.050, 0.004**2 * weights[1]), rel=1e-5)
    share = 0.008**2 / (0.008**2 + 1 / weights.sum())
    measured = np.average([0.032, 0.050], weights=weights)
    assert growth.pace_m == pytest.approx(0.03 + share * (measured - 0.03), rel=1e-5)


def test_same_measurement_in_two_links_counts_once() -> None:
    first = Link("a", "1", 0, 0.10, 0.004, 2, 0.16, 0.004)
    second = Link("a", "1", 2, 0.16, 0.004, 4, 0.22, 0.004)
    around = Link("a", "1", 0, 0.10, 0.004, 4, 0.22, 0.004)
    two = fit_growth([first, second], PRIOR)
    three = fit_growth([first, second, around], PRIOR)
    assert (two.pace_m, two.rows, two.fruit_sd_m) == (three.pace_m, three.rows, three.fruit_sd_m)


def test_no_link_leaves_the_prior() -> None:
    growth = fit_growth([], PRIOR)
    assert growth.mean_m == 0.03
    assert house_sd(growth) == 0.008
    assert growth.fruit_sd_m == 0.005
    assert growth.rows == {}


@pytest.mark.parametrize("true_m", [0.015, 0.03, 0.05])
def test_links_overrule_the_prior(true_m: float) -> None:
    house = simulate_house(HouseSettings(true_m, SPREADS, links=300), seed=3)
    growth = fit_growth(house.links, PRIOR)
    assert abs(growth.mean_m - true_m) < 2.58 * house_sd(growth)
    assert 2 * 2.58 * house_sd(growth) < 0.015  # the weather of four days remains


def test_rows_are_told_apart() -> None:
    spreads = Spreads(0.008, 0.006, 0.002, 0.001, 0.001)
    house = simulate_house(HouseSettings(0.03, spreads, rows=4, links=400), seed=5)
    growth = fit_growth(house.links, PRIOR)
    measured = {
        row: float(np.mean([(k.length1_m - k.length0_m) / 2 for k in house.links if k.row == row]))
        for row in growth.rows
    }
    fitted = {row: mean_m for row, (mean_m, _) in growth.rows.items()}
    assert sorted(measured, key=measured.__getitem__) == sorted(fitted, key=fitted.__getitem__)
    assert max(fitted.values()) - min(fitted.values()) > 0.004
    assert min(weight for _, weight in growth.rows.values()) > 0.7


@pytest.mark.parametrize("true_m", [0.0025, 0.005, 0.01])
def test_difference_between_fruit_is_learnt(true_m: float) -> None:
    spreads = replace(SPREADS, fruit=true_m)
    fitted = [
        fit_growth(
            simulate_house(HouseSettings(0.03, spreads, links=500), seed=seed).links, PRIOR
        ).fruit_sd_m
        for seed in range(5)
    ]
    assert np.mean(fitted) == pytest.approx(true_m, rel=0.12)


def test_exact_lengths_of_equal_fruit_keep_some_difference_between_them() -> None:
    links = [Link(str(k), "1", 0, 0.2, 1e-6, 2, 0.26, 1e-6) for k in range(500)]
    assert 0.001 < fit_growth(links, PRIOR).fruit_sd_m < 0.002


def test_fast_fruit_without_a_link_do_not_make_the_house_slow() -> None:
    # Whoever grew faster than 5 cm a day was shorter than 5 cm four days ago, and has no link.
    rng = np.random.default_rng(2)
    growths = rng.normal(0.03, 0.01, 4000)
    lengths = rng.uniform(0.05, 0.40, 4000)
    links = [
        Link(str(k), "1", 0, length - 4 * pace, 0.001, 4, length, 0.001)
        for k, (pace, length) in enumerate(zip(growths, lengths, strict=True))
        if length - 4 * pace > 0.05
    ]
    all_m = np.mean([(k.length1_m - k.length0_m) / 4 for k in links])
    prior = replace(PRIOR, spreads=replace(SPREADS, day=1e-6, fruit=0.01))
    fitted = fit_growth(links, prior).mean_m
    assert all_m < 0.0285
    assert fitted == pytest.approx(0.03, abs=0.0006)


def test_short_fruit_count_where_no_long_ones_have_links() -> None:
    links = [Link(str(k), "1", 0, 0.06, 0.002, 2, 0.12, 0.002) for k in range(5)]
    assert fit_growth(links, replace(PRIOR, mean_m=0.02)).pace_m > 0.025


def test_growth_that_slows_is_measured_against_the_length() -> None:
    # 30 cm long, a fruit that stops at 40 cm grows by half of its full 3 cm a day.
    links = [Link(str(k), "1", 0, 0.285, 0.003, 2, 0.315, 0.003) for k in range(300)]
    prior = replace(PRIOR, spreads=replace(SPREADS, day=1e-6))
    assert fit_growth(links, prior).mean_m == pytest.approx(0.015, abs=0.001)
    assert fit_growth(links, replace(prior, full_m=0.40)).mean_m == pytest.approx(0.03, abs=0.001)
