from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.growth import (
    FruitState,
    GrowthPrior,
    Spreads,
    fit_growth,
    length_of,
    rate_share,
    stage_of,
)
from cucumbervision_lab.evaluate.harvests import HouseSettings, simulate_house

SPREADS = Spreads(0.008, 0.002, 0.005, 0.003, 0.003)
SLOWING = GrowthPrior.of(load_profile("long-cucumber"))
PRIOR = replace(SLOWING, full_m=(math.inf,))
BETWEEN = math.hypot(0.005, 0.002)  # fruit of a row, and rows


def twice(
    name: str, row: str, day0: float, before_m: float, sd0_m: float, day1: float, *last: float
) -> FruitState:
    """Return a fruit that was measured on two days."""
    earlier = ((day0, before_m, sd0_m),)
    return FruitState(name, row, 0.0, last[0], last[1], day1, earlier=earlier)


def test_one_fruit_by_hand() -> None:
    # 10 cm in 2 days: 5 cm a day, whose variance is that of both lengths and of two days over 2²,
    # of its row and of itself, and of the weather of these days.
    [curve] = fit_growth([twice("a", "1", 0, 0.15, 0.004, 2, 0.25, 0.003)], PRIOR).curves
    error = (0.004**2 + 2 * (0.003**2 + 0.003**2) + 0.003**2) / 2**2 + BETWEEN**2 + 0.003**2 / 2
    share = 0.008**2 / (0.008**2 + error)
    assert curve.mean_m == pytest.approx(0.03 + share * (0.05 - 0.03))
    assert curve.sd_m == pytest.approx(math.sqrt(share * error))
    # A single fruit says nothing of the difference between fruit.
    assert curve.fruit_sd_m == pytest.approx(BETWEEN)


def test_several_fruit_by_hand() -> None:
    links = [
        twice(str(pace), "1", 0, 0.15, 1e-6, 2, 0.15 + 2 * pace, 1e-6)
        for pace in (0.030, 0.034, 0.050)
    ]
    spreads = replace(SPREADS, day=1e-9, fruit_day=1e-9)
    [curve] = fit_growth(links, replace(PRIOR, spreads=spreads)).curves
    # About the mean of 3.8 cm with two degrees of freedom; the profile counts for four.
    scatter = 0.008**2 + 0.004**2 + 0.012**2
    variance = (4 * BETWEEN**2 + scatter) / (4 + 2)
    assert curve.fruit_sd_m == pytest.approx(math.sqrt(variance), rel=1e-5)
    share = 0.008**2 / (0.008**2 + variance / 3)
    assert curve.mean_m == pytest.approx(0.03 + share * 0.008, rel=1e-5)


def test_no_link_leaves_the_prior() -> None:
    growth = fit_growth([], PRIOR)
    assert (growth.mean_m, growth.mean_sd_m) == pytest.approx((0.03, 0.008))
    assert growth.curves[0].fruit_sd_m == BETWEEN
    every = fit_growth([], SLOWING).curves
    # Growth that does not slow, or stops at one of six lengths: for ranges, for what is expected.
    assert [curve.weight for curve in every] == pytest.approx([0.25, *[0.125] * 6])
    assert [curve.share for curve in every] == pytest.approx([0.75, *[0.25 / 6] * 6])


@pytest.mark.parametrize("true_m", [0.015, 0.03, 0.05])
def test_links_overrule_the_prior(true_m: float) -> None:
    house = simulate_house(HouseSettings(true_m, SPREADS, links=300), seed=3)
    growth = fit_growth(house.fruit, PRIOR)
    assert abs(growth.mean_m - true_m) < 2.58 * growth.mean_sd_m
    assert 2 * 2.58 * growth.mean_sd_m < 0.015  # the weather of four days remains


@pytest.mark.parametrize("true_m", [0.0025, 0.005, 0.01])
def test_difference_between_fruit_is_learnt(true_m: float) -> None:
    spreads = replace(SPREADS, fruit=true_m)
    fitted = [
        fit_growth(simulate_house(HouseSettings(0.03, spreads, links=500), seed=seed).fruit, PRIOR)
        .curves[0]
        .fruit_sd_m
        for seed in range(5)
    ]
    assert np.mean(fitted) == pytest.approx(math.hypot(true_m, spreads.row), rel=0.12)


def test_fast_fruit_without_a_link_do_not_make_the_house_slow() -> None:
    # Whoever grew faster than 5 cm a day was shorter than 5 cm four days ago, and has no link.
    rng = np.random.default_rng(2)
    growths = rng.normal(0.03, 0.01, 4000)
    lengths = rng.uniform(0.05, 0.40, 4000)
    links = [
        twice(str(k), "1", 0, length - 4 * pace, 0.001, 4, length, 0.001)
        for k, (pace, length) in enumerate(zip(growths, lengths, strict=True))
        if length - 4 * pace > 0.05
    ]
    all_m = np.mean([(k.length_m - k.earlier[0][1]) / 4 for k in links])
    prior = replace(PRIOR, spreads=replace(SPREADS, day=1e-6, fruit=0.01))
    fitted = fit_growth(links, prior).mean_m
    assert all_m < 0.0285
    assert fitted == pytest.approx(0.03, abs=0.0006)


def test_short_fruit_count_where_no_long_ones_have_links() -> None:
    links = [twice(str(k), "1", 0, 0.06, 0.002, 2, 0.12, 0.002) for k in range(5)]
    assert fit_growth(links, replace(PRIOR, mean_m=0.02)).mean_m > 0.025


def test_growth_that_slows_is_measured_against_the_length() -> None:
    # About 30 cm long, a fruit that stops at 40 cm grows by half of its full 3 cm a day.
    links = [twice(str(k), "1", 0, 0.285, 0.003, 2, 0.315, 0.003) for k in range(300)]
    prior = replace(PRIOR, spreads=replace(SPREADS, day=1e-6))
    assert fit_growth(links, prior).mean_m == pytest.approx(0.015, abs=0.001)
    slowing = replace(prior, full_m=(0.40,))
    assert fit_growth(links, slowing).mean_m == pytest.approx(0.03, abs=0.001)


@pytest.mark.parametrize(("full_m", "least", "most"), [(0.40, 2, 3), (0.45, 1.7, 2.7), (9, 0, 1)])
def test_length_at_which_growth_stops_is_learnt(full_m: float, least: float, most: float) -> None:
    settings = HouseSettings(0.03, SPREADS, links=300, full_m=full_m)
    fitted = [fit_growth(simulate_house(settings, seed).fruit, SLOWING) for seed in range(4)]
    assert least < np.mean([sum(c.weight / c.full_m for c in g.curves) for g in fitted]) < most
    assert np.mean([growth.mean_m for growth in fitted]) == pytest.approx(0.03, abs=0.004)


@pytest.mark.parametrize("full_m", [0.30, 0.40, math.inf])
def test_stage_is_the_time_that_growth_took(full_m: float) -> None:
    # Euler's steps of 0.01 mm, growing by the share that is left at each length.
    length_m, stage_m = 0.05, 0.05
    while length_m < 0.27:
        stage_m += 1e-5 / float(rate_share(length_m, full_m))
        length_m += 1e-5
    assert float(stage_of(np.array(length_m), full_m)) == pytest.approx(stage_m, abs=2e-4)
    lengths_m = np.array([-0.1, 0.05, 0.2, 0.25, 0.29, 0.35, 0.6])
    assert length_of(stage_of(lengths_m, full_m), full_m) == pytest.approx(lengths_m)
    assert (np.diff(stage_of(lengths_m, full_m)) > 0).all()
