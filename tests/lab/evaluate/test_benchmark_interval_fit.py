from __future__ import annotations

from typing import TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.methods.intervals import Band, IntervalModel, Trees
from cucumbervision_lab.evaluate.benchmark import conformal_quantile, fit_interval_model

Array: TypeAlias = NDArray[np.float64]


def test_the_conformal_rank_by_hand() -> None:
    # n = 9, level 0.9: rank ceil(9) = 9, the largest; n = 8 cannot carry it.
    assert conformal_quantile(np.arange(9), 0.9) == 8.0
    with pytest.raises(ValueError, match=r"8 fruit are too few for a level of 0\.9: need 9"):
        conformal_quantile(np.arange(8), 0.9)


def simulated(rng: np.random.Generator, count: int) -> tuple[Array, dict[str, Array]]:
    tilt, hidden = rng.uniform(0, 1, count), rng.uniform(0, 0.6, count)
    sigma = 0.004 * np.exp(1.5 * tilt + 2.0 * hidden)
    return 0.002 + sigma * rng.standard_normal(count), {"tilt": tilt, "hidden": hidden}


def test_intervals_cover_new_fruit_in_every_group() -> None:
    rng = np.random.default_rng(3)
    errors, features = simulated(rng, 3000)
    model = fit_interval_model("M6", errors, features, np.arange(3000).astype(str))
    for tilt, hidden in ((0.1, 0.1), (0.5, 0.3), (0.9, 0.5)):
        # 90 % of the errors, which are 0.002 too long, and the least spread, 0.002, beyond.
        size = 1.2816 * 0.004 * np.exp(1.5 * tilt + 2.0 * hidden)
        below, above = model.spreads({"tilt": tilt, "hidden": hidden})
        assert (below, above) == pytest.approx((size, size + 0.004), rel=0.3)
    errors, features = simulated(rng, 8000)
    truth = 0.2
    covered = np.empty(8000, bool)
    for k, error in enumerate(errors):
        values = {name: float(column[k]) for name, column in features.items()}
        low, high = model.interval(truth * np.exp(error), values)
        covered[k] = low <= truth <= high
    assert covered.mean() == pytest.approx(0.90, abs=0.015)
    for name, limit in (("tilt", 0.5), ("hidden", 0.3)):
        for group in (features[name] < limit, features[name] >= limit):
            assert covered[group].mean() == pytest.approx(0.90, abs=0.03)


def test_an_unknown_depth_scale_widens_the_interval_by_hand() -> None:
    spread = Trees(np.log(0.01))
    model = IntervalModel("M6", 0.9, (), spread, spread, {"": Band(1.5, 1.5, 100)})
    low, high = model.interval(0.3, {}, 0.01)
    half = np.hypot(1.5 * 0.01, 1.6449 * 0.01)
    assert low == pytest.approx(0.3 * np.exp(-half), rel=1e-4)
    assert high == pytest.approx(0.3 * np.exp(half), rel=1e-4)


def test_a_method_that_reads_short_gets_a_long_upper_end() -> None:
    rng = np.random.default_rng(8)
    errors = -rng.exponential(0.1, 4000)  # never long, at times far too short
    model = fit_interval_model("M1", errors, {}, np.arange(4000).astype(str))
    low, high = model.interval(0.2, {})
    assert 0.2 - low < 0.3 * (high - 0.2)
    covered = [low <= 0.2 / np.exp(e) <= high for e in -rng.exponential(0.1, 4000)]
    assert np.mean(covered) == pytest.approx(0.90, abs=0.02)


def test_readings_of_one_fruit_stay_in_one_fifth() -> None:
    # A feature that numbers the fruit, and an error that each fruit has of its own: trees know the
    # errors of the fruit they were fitted on, so that the scores of others are larger.
    rng = np.random.default_rng(5)
    fruit = np.repeat(np.arange(10), 100)
    errors = np.exp(rng.normal(-4, 1.5, 10))[fruit] * rng.choice([-1, 1], 1000)
    features = {"number": fruit.astype(float)}
    apart = fit_interval_model("M6", errors, features, fruit.astype(str))
    mixed = fit_interval_model("M6", errors, features, np.arange(1000).astype(str))
    assert apart.above == mixed.above
    assert apart.bands[""].high_quantile > 1.5 * mixed.bands[""].high_quantile
    assert apart.bands[""].count == mixed.bands[""].count == 1000
