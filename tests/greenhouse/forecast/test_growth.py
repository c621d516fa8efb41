from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.growth import (
    Curve,
    FruitState,
    Growth,
    GrowthPrior,
    Spreads,
    draw_lengths,
    fit_growth,
    fruit_lines,
    length_of,
    lengths_today,
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


DRAWN_PRIOR = GrowthPrior(0.03, SPREADS, shortest_m=0.05)


def known(mean_m: float) -> Growth:
    """Return a house whose growth is known."""
    return Growth(DRAWN_PRIOR, (Curve(np.inf, mean_m, 0.0, 0.005),))


def drawn(fruit: list[FruitState], growth: Growth, today: float, days: int = 7) -> np.ndarray:
    rng = np.random.default_rng(4)
    return draw_lengths(fruit, growth, today, days, 20000, 0.0, rng, 0.05)[0]


def test_line_is_the_joint_normal_posterior() -> None:
    """Held against the normal equations of a length and a growth, the house a measurement."""
    days, sd_m = np.array([0.0, 2.0, 3.0]), np.array([0.004, 0.005, 0.006])
    lengths_m, house_m = np.array([0.15, 0.20, 0.245]), 0.035
    earlier = ((0.0, 0.15, 0.004), (2.0, 0.20, 0.005))
    growth = known(0.03)
    fruit = [FruitState("a", "1", 0.0, 0.245, 0.006, 3.0, earlier=earlier)]
    lines = fruit_lines(fruit, growth, growth.curves[0], 0.0)
    design = np.array([[1, -3], [1, -1], [1, 0], [0, 1]])
    daily = 0.003**2 + 0.003**2
    precision = np.diag(1 / np.array([*(sd_m**2 + daily * (3 - days)), 0.005**2]))
    covariance = np.linalg.inv(design.T @ precision @ design)
    mean = covariance @ design.T @ precision @ np.array([*lengths_m, house_m])
    assert lines.stage_m[0, 0] + lines.stage_m[1, 0] * house_m == pytest.approx(mean[0])
    assert lines.growth_m[0, 0] + lines.growth_m[1, 0] * house_m == pytest.approx(mean[1])
    np.testing.assert_allclose(lines.covariance[:, 0], covariance[[0, 0, 1], [0, 1, 1]])


def test_fruit_seen_once_grow_like_their_house() -> None:
    [fruit] = [FruitState("a", "1", 0.0, 0.20, 0.004, 2.0)]
    mean_m, sd_m = lengths_today([fruit], known(0.045), 4.0, 0.0)
    assert mean_m[0] == pytest.approx(0.20 + 2 * 0.045)
    daily = 0.003**2 + 0.003**2
    assert sd_m[0] == pytest.approx((0.004**2 + 4 * 0.005**2 + 2 * daily) ** 0.5)


@pytest.mark.parametrize("scale_sd", [0.0, 0.01])
def test_drawn_lengths_have_the_mean_and_deviation_of_today(scale_sd: float) -> None:
    fruit = [
        FruitState("a", "1", 0.0, 0.20, 0.004, 2, earlier=((0, 0.11, 0.004),)),
        FruitState("b", "1", 0.0, 0.18, 0.006, 2),
        FruitState("c", "2", 0.0, 0.18, 0.006, 2),
    ]
    before = ((0, 0.15, 0.004),)
    others = [FruitState(str(k), "1", 0.0, 0.23, 0.004, 2, earlier=before) for k in range(6)]
    growth = fit_growth([*fruit, *others], DRAWN_PRIOR)
    mean_m, sd_m = lengths_today(fruit, growth, 5.0, scale_sd)
    rng = np.random.default_rng(1)
    lengths_m = draw_lengths(fruit, growth, 5.0, 0, 20000, scale_sd, rng, 0.05)[0][0]
    np.testing.assert_allclose(lengths_m.mean(axis=0), mean_m, atol=0.0006)
    np.testing.assert_allclose(lengths_m.std(axis=0), sd_m, rtol=0.03)
    assert mean_m[0] > 0.20 + 3 * 0.036  # the fast fruit of a fast house


def test_measured_shrinking_is_no_shrinking() -> None:
    # 21 cm, two days later 19 cm: 20 ± 1 cm both times, and slow.
    fruit = [FruitState("a", "1", 0.0, 0.19, 0.008, 2.0, earlier=((0, 0.21, 0.008),))]
    lengths_m = drawn(fruit, known(0.03), 2.0)
    assert (np.diff(lengths_m[:, :, 0], axis=0) >= 0).all()
    assert 0.195 < lengths_m[0].mean() < 0.21
    usual_m = drawn([replace(fruit[0], earlier=())], known(0.03), 2.0)
    grown_m = (lengths_m[7] - lengths_m[0]).mean()
    assert 0.1 < grown_m < (usual_m[7] - usual_m[0]).mean() - 0.01


def test_today_does_not_depend_on_the_days_ahead() -> None:
    fruit = [FruitState("a", "1", 0.0, 0.15, 0.004)]
    growth = fit_growth([], DRAWN_PRIOR)
    np.testing.assert_array_equal(
        drawn(fruit, growth, 2.0, days=0)[0], drawn(fruit, growth, 2.0, days=5)[0]
    )


def test_curves_are_drawn_by_their_weights() -> None:
    curves = (Curve(0.40, 0.03, 0.0, 1e-6, 0.25, 0.25), Curve(np.inf, 0.03, 0.0, 1e-6, 0.75, 0.75))
    growth = Growth(DRAWN_PRIOR, curves)
    fruit = [FruitState("a", "1", 0.0, 0.30, 1e-6, 1.0)]
    lengths_m = drawn(fruit, growth, 3.0)[0, :, 0]
    mean_m, sd_m = lengths_today(fruit, growth, 3.0, 0.0)
    assert (lengths_m[:5000].mean(), lengths_m[5000:].mean()) == pytest.approx(
        (0.40 - 0.10 * np.exp(-0.30), 0.36), abs=0.001
    )
    assert (lengths_m.mean(), lengths_m.std()) == pytest.approx((mean_m[0], sd_m[0]), rel=0.02)
