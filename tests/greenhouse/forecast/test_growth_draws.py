from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision_greenhouse.forecast.growth import (
    Curve,
    FruitState,
    Growth,
    GrowthPrior,
    Spreads,
    draw_lengths,
    fit_growth,
    fruit_lines,
    lengths_today,
)

SPREADS = Spreads(0.008, 0.002, 0.005, 0.003, 0.003)
PRIOR = GrowthPrior(0.03, SPREADS, shortest_m=0.05)


def known(mean_m: float) -> Growth:
    """Return a house whose growth is known."""
    return Growth(PRIOR, (Curve(np.inf, mean_m, 0.0, 0.005),))


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
    growth = fit_growth([*fruit, *others], PRIOR)
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
    growth = fit_growth([], PRIOR)
    np.testing.assert_array_equal(
        drawn(fruit, growth, 2.0, days=0)[0], drawn(fruit, growth, 2.0, days=5)[0]
    )


def test_curves_are_drawn_by_their_weights() -> None:
    curves = (Curve(0.40, 0.03, 0.0, 1e-6, 0.25, 0.25), Curve(np.inf, 0.03, 0.0, 1e-6, 0.75, 0.75))
    growth = Growth(PRIOR, curves)
    fruit = [FruitState("a", "1", 0.0, 0.30, 1e-6, 1.0)]
    lengths_m = drawn(fruit, growth, 3.0)[0, :, 0]
    mean_m, sd_m = lengths_today(fruit, growth, 3.0, 0.0)
    assert (lengths_m[:5000].mean(), lengths_m[5000:].mean()) == pytest.approx(
        (0.40 - 0.10 * np.exp(-0.30), 0.36), abs=0.001
    )
    assert (lengths_m.mean(), lengths_m.std()) == pytest.approx((mean_m[0], sd_m[0]), rel=0.02)
