"""The forecast in few simulated houses, with one number of links."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cucumbervision_lab.evaluate.harvests import Scenario, run_house


@pytest.mark.parametrize("full_m", [math.inf, 0.45])
def test_intervals_hold_and_naive_growth_is_beaten(full_m: float) -> None:
    scenario = Scenario("50 links", 50, full_m=full_m)
    outcomes = [run_house(scenario, seed) for seed in range(10)]
    share, error, naive, picks, picks_error = np.mean(outcomes, axis=0)
    # 10 houses of about 12 dependent cells: the mean's standard error is some 5 %.
    assert 0.65 < share < 0.97
    assert error < 0.9 * naive
    assert picks_error < 0.2 * picks
