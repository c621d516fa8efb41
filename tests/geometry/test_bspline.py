from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.geometry.tube import cubic_basis, differences


@pytest.mark.parametrize("segments", [1, 4, 12])
def test_weights_sum_to_one_and_are_never_negative(segments: int) -> None:
    basis = cubic_basis(np.linspace(0, 1, 101), segments)
    assert basis.shape == (101, segments + 3)
    np.testing.assert_allclose(basis.sum(axis=1), 1)
    assert basis.min() >= 0


def test_evenly_spaced_controls_make_a_straight_line() -> None:
    t = np.linspace(0, 1, 33)
    controls = np.arange(7) - 1.0  # a spline of four segments: its ends lie one control in
    np.testing.assert_allclose(cubic_basis(t, 4) @ controls, 4 * t, atol=1e-12)


def test_a_cubic_has_even_third_differences() -> None:
    controls = np.arange(7.0) ** 3
    np.testing.assert_allclose(differences(7, 3) @ controls, 6)
