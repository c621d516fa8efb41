from __future__ import annotations

import math

import numpy as np
import pytest

from cucumbervision.accuracy.statistics import bootstrap_mean
from cucumbervision_lab.detection.estimates import estimate, scene_weights, share


@pytest.mark.parametrize("quantile", [0.0, 0.25, 0.5, 0.9, 1.0])
def test_quantiles_are_numpys(quantile: float) -> None:
    values = np.random.default_rng(1).lognormal(size=41)
    found = estimate(values, list(range(41)), quantile)
    assert found.value == pytest.approx(np.quantile(values, quantile))
    assert found.low <= found.value <= found.high


def test_mean_and_interval_agree_with_the_benchmarks_own() -> None:
    rng = np.random.default_rng(2)
    scenes = np.repeat(np.arange(20), 3)
    values = rng.normal(size=20)[scenes] + 0.1 * rng.normal(size=60)
    found = estimate(values, scenes.tolist())
    low, high = bootstrap_mean(values, scenes.tolist())
    assert found.value == pytest.approx(values.mean())
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.05)
    # Three values of a scene are hardly more than one: the interval by value is far too narrow.
    by_value = estimate(values, list(range(60)))
    assert found.high - found.low > 1.5 * (by_value.high - by_value.low)


def test_weights_draw_as_many_scenes_as_there_are() -> None:
    weights = scene_weights(7, 50)
    assert weights.shape == (50, 7)
    assert (weights.sum(axis=1) == 7).all()
    assert (weights != weights[0]).any()


def test_all_hits_leave_room_for_doubt() -> None:
    # The exact interval of 20 hits in 20 trials starts at 0.025 ** (1 / 20).
    found = share([True] * 60, [k // 3 for k in range(60)])
    assert (found.value, found.high, found.scenes) == (1.0, 1.0, 20)
    assert found.low == pytest.approx(0.025 ** (1 / 20))
    none = share([False] * 20, list(range(20)))
    assert none.high == pytest.approx(1 - 0.025 ** (1 / 20))


def test_nothing_and_one_scene_have_no_interval() -> None:
    assert math.isnan(share([], []).value)
    one = share([True, False], ["a", "a"])
    assert (one.value, one.count, one.scenes) == (0.5, 2, 1)
    assert math.isnan(one.low)
    assert one.as_json() == {"value": 0.5, "low": None, "high": None, "n": 2, "scenes": 1}
