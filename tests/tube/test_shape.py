from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from cucumbervision.tube.shape import cubic_basis


@pytest.mark.parametrize("segments", [1, 4, 12])
def test_weights_sum_to_one_and_are_never_negative(segments: int) -> None:
    basis = cubic_basis(np.linspace(0, 1, 101), segments)
    assert basis.shape == (101, segments + 3)
    np.testing.assert_allclose(basis.sum(axis=1), 1)
    assert basis.min() >= 0


@pytest.mark.parametrize("segments", [1, 4, 12])
def test_weights_are_scipys_to_the_last_bit(segments: int) -> None:
    places = np.concatenate([np.linspace(0, 1, 64), [1 / 3, 0.25]])
    knots = np.arange(-3, segments + 4) / segments
    expected = BSpline.design_matrix(places, knots, 3).toarray()
    assert np.array_equal(cubic_basis(places, segments), expected)


def test_evenly_spaced_controls_make_a_straight_line() -> None:
    t = np.linspace(0, 1, 33)
    controls = np.arange(7) - 1.0  # a spline of four segments: its ends lie one control in
    np.testing.assert_allclose(cubic_basis(t, 4) @ controls, 4 * t, atol=1e-12)
