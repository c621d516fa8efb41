from __future__ import annotations

import numpy as np
import pytest
from tests.simulated_houses import HouseSettings, simulate_house

from cucumbervision.agronomy.profiles import load_profile
from cucumbervision.errors import ForecastError
from cucumbervision_greenhouse.agronomy.growth import (
    LINEAR,
    Basis,
    Curve,
    Growth,
    GrowthPrior,
    Link,
    Spreads,
    fit_growth,
    kalman_filter,
    measured_histories,
)

SPREADS = Spreads(0.008, 0.002, 0.005, 0.003, 0.003)
PRIOR = GrowthPrior.of(load_profile("long-cucumber"))


def house_rate(growth: Growth) -> tuple[float, float]:
    """Mean and standard deviation of the house's growth over all draws of the spreads."""
    means, own = growth.mean[:, 0], growth.root[:, 0]
    return float(means.mean()), float(np.sqrt(means.var() + (own**2).sum(axis=1).mean()))


def test_filter_is_the_joint_normal_posterior() -> None:
    """Held against the whole covariance of one fruit with three lengths."""
    days, sd = np.array([0.0, 2.0, 3.0]), np.array([0.004, 0.005, 0.006])
    lengths, mu = np.array([0.15, 0.20, 0.245]), 0.03
    basis = Basis(("r",), 0, 0)
    seen = measured_histories(
        [list(zip(days, lengths, sd**2, strict=True))], ["r"], basis, until=4.0
    )
    found = kalman_filter(seen, SPREADS)
    # x(t) = x0 + (mu + b) t + sum of daily luck, x0 with a practically flat prior; days outside
    # the basis bring the weather's variance as well.
    luck = SPREADS.fruit_day**2 + SPREADS.day**2
    times = np.array([*days, 4.0])
    cov = 10.0 + np.outer(times, times) * SPREADS.fruit**2 + luck * np.minimum.outer(times, times)
    cov_b = np.concatenate([times * SPREADS.fruit**2, [SPREADS.fruit**2]])
    joint = np.block([[cov, cov_b[:4, None]], [cov_b[None, :4], cov_b[None, 4:]]])
    gain = joint[3:, :3] @ np.linalg.inv(joint[:3, :3] + np.diag(sd**2))
    mean = np.array([mu * 4.0, 0.0]) + gain @ (lengths - mu * days)
    left = joint[3:, 3:] - gain @ joint[:3, 3:]
    beta = np.array([mu, 0.0])
    assert found.length[0, 0] + found.length[0, 1:] @ beta == pytest.approx(mean[0], abs=1e-6)
    assert found.growth[0, 0] + found.growth[0, 1:] @ beta == pytest.approx(mean[1], abs=1e-6)
    np.testing.assert_allclose(found.covariance[0], [left[0, 0], left[0, 1], left[1, 1]], atol=1e-7)


def test_same_measurement_in_two_links_counts_once() -> None:
    first = Link("a", "1", 0, 0.10, 0.004, 2, 0.16, 0.004)
    second = Link("a", "1", 2, 0.16, 0.004, 4, 0.22, 0.004)
    around = Link("a", "1", 0, 0.10, 0.004, 4, 0.22, 0.004)
    two = fit_growth([first, second], PRIOR)
    three = fit_growth([first, second, around], PRIOR)
    np.testing.assert_array_equal(two.mean, three.mean)


def test_no_link_leaves_the_prior() -> None:
    growth = fit_growth([], PRIOR)
    assert growth.curve is LINEAR
    mean_m, sd_m = house_rate(growth)
    assert mean_m == pytest.approx(0.03)
    # Wider than 0.8 cm, since the spread itself is not sure.
    assert 0.008 < sd_m < 1.35 * 0.008


@pytest.mark.parametrize("true_m", [0.015, 0.03, 0.05])
def test_links_overrule_the_prior(true_m: float) -> None:
    house = simulate_house(HouseSettings(true_m, SPREADS, links=300), seed=3)
    mean_m, sd_m = house_rate(fit_growth(house.links, PRIOR))
    assert abs(mean_m - true_m) < 2.58 * sd_m
    assert 2 * 2.58 * sd_m < 0.015  # three days' weather of the house remains


def test_rows_are_told_apart() -> None:
    spreads = Spreads(0.008, 0.006, 0.002, 0.001, 0.001)
    house = simulate_house(HouseSettings(0.03, spreads, rows=4, links=400), seed=5)
    growth = fit_growth(house.links, PRIOR)
    seen = {
        row: np.mean([(k.length1_m - k.length0_m) / 2 for k in house.links if k.row == row])
        for row in growth.basis.rows
    }
    fitted = dict(zip(growth.basis.rows, growth.mean[:, 1:].mean(axis=0).tolist(), strict=False))
    assert sorted(seen, key=lambda r: seen[r]) == sorted(fitted, key=lambda r: fitted[r])
    assert max(fitted.values()) - min(fitted.values()) > 0.004


def test_slowing_growth_is_found_and_steady_growth_is_left_alone() -> None:
    steady = simulate_house(HouseSettings(0.03, SPREADS, links=400), seed=1)
    assert fit_growth(steady.links, PRIOR).curve is LINEAR
    slowing = simulate_house(HouseSettings(0.03, SPREADS, links=400, full_m=0.45), seed=1)
    assert fit_growth(slowing.links, PRIOR).curve.full_m == pytest.approx(0.43, abs=0.04)


def test_unslowed_length_grows_as_fast_everywhere() -> None:
    curve = Curve(0.45)
    lengths = [0.10]
    for _ in range(4000):  # a rate of 3 cm a day for 10 days, in small steps
        lengths.append(lengths[-1] + 0.03 * 10 / 4000 * float(curve.rate_share(lengths[-1])))
    grown = curve.unslowed(lengths[-1]) - curve.unslowed(lengths[0])
    assert float(grown) == pytest.approx(0.30, rel=1e-4)
    assert lengths[-1] < 0.36


def test_points_count_by_their_error_and_the_slope_that_was_expected() -> None:
    curve = Curve(0.40)
    (_, u0, v0), (_, u1, v1) = curve.points([(0, 0.10, 0.004), (4, 0.30, 0.004)], pace_m=0.05)
    assert u0 == 0.10
    assert v0 == pytest.approx(0.004**2)
    assert u1 == pytest.approx(0.2 + 0.2 * np.log(2))
    # 0.10 + 4 days of 0.05 = 0.30 unslowed is exp(1 - 0.30 / 0.20) = 0.61 of full growth.
    assert v1 == pytest.approx((0.004 / np.exp(-0.5)) ** 2)


@pytest.mark.parametrize(
    "change",
    [{"day1": 0.0}, {"length0_m": -0.1}, {"sd1_m": 0.0}, {"length1_m": float("nan")}],
)
def test_link_that_cannot_be_is_refused(change: dict[str, float]) -> None:
    days, lengths = {"day0": 0.0, "day1": 1.0}, {"length0_m": 0.2, "length1_m": 0.23}
    good = {**days, **lengths, "sd0_m": 0.004, "sd1_m": 0.004}
    with pytest.raises(ForecastError, match=r"link of fruit 'a': .*; give finite days"):
        Link("a", "1", **{**good, **change})
