"""Positions and lengths of several views of one fruit, by values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.methods.matching import SHARED, Crowd, pooled_length, position_ratio

CROWD = Crowd(per_m=5.0, up_m=1.0, depth_m=0.3, length_width=0.3, diameter_width=0.1)
WHOLE = np.zeros(2, bool)


def test_views_at_one_place_are_of_one_fruit_and_far_ones_are_not() -> None:
    variance_m2 = np.full((3, 3), 0.02**2)
    gaps_m = np.array([[0.0, 0.0, 0.0], [0.03, 0.03, 0.0], [0.3, 0.3, 0.2]])
    same, near, far = position_ratio(gaps_m, variance_m2, CROWD)
    assert same > near > 0 > far


def test_a_denser_crowd_makes_every_match_less_sure_by_its_logarithm() -> None:
    gap_m, variance_m2 = np.zeros((1, 3)), np.full((1, 3), 0.02**2)
    denser = Crowd(per_m=10.0, up_m=1.0, depth_m=0.3, length_width=0.3, diameter_width=0.1)
    first, second = (position_ratio(gap_m, variance_m2, crowd)[0] for crowd in (CROWD, denser))
    assert first - second == pytest.approx(np.log(2))


def test_a_pooled_length_is_the_weighted_mean_and_keeps_the_shared_variance() -> None:
    # Two equal readings: the own half of the variance is halved, the shared half stays.
    length_m, sd_m = pooled_length(np.full(2, 0.3), np.full(2, 0.02), WHOLE) or (0.0, 0.0)
    assert length_m == pytest.approx(0.3)
    assert sd_m / length_m == pytest.approx(0.02 * np.sqrt(SHARED + (1 - SHARED) / 2))


def test_views_that_contradict_each_other_widen_by_birges_ratio() -> None:
    # 10 % apart at 1 % each: the sum of squares is 2 (0.05 / 0.01)^2 = 50 about the mean.
    lengths_m = np.exp(np.log(0.3) + np.array([-0.05, 0.05]))
    _, sd_m = pooled_length(lengths_m, np.full(2, 0.01), WHOLE) or (0.0, 0.0)
    expected = 0.01 * np.sqrt(0.75 * 50)
    assert sd_m / 0.3 == pytest.approx(expected, rel=1e-6)


def test_lower_bounds_alone_give_no_length() -> None:
    assert pooled_length(np.full(2, 0.3), np.full(2, 0.02), ~WHOLE) is None
