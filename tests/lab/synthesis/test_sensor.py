from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.synthesis.sensor import noisy_depth


@pytest.mark.parametrize("depth_m", [0.4, 0.8])
def test_noise_grows_with_the_square_of_the_distance(depth_m: float) -> None:
    burst = np.array(
        noisy_depth(np.full((300, 300), depth_m), 924.0, 5, np.random.default_rng(3), 1e-5)
    )
    sigma = depth_m**2 * 0.08 / (640 * 0.05)
    assert (burst - depth_m).std() == pytest.approx(sigma, rel=0.15)


def test_a_burst_median_leaves_the_part_fixed_in_space() -> None:
    burst = np.array(
        noisy_depth(np.full((300, 300), 0.6), 924.0, 5, np.random.default_rng(3), 1e-5)
    )
    left = np.median(burst, axis=0).std() / burst[0].std()
    assert 0.8 < left < 0.95  # sqrt(0.7) = 0.84 is fixed; a mean of five would leave 0.87


def test_readings_are_whole_units_and_holes_stand_at_jumps() -> None:
    depth = np.full((80, 80), 0.5)
    depth[:, 40:] = 0.9
    depth[:10] = 0.0
    reading = noisy_depth(depth, 924.0, 1, np.random.default_rng(1))[0]
    assert np.abs(reading / 0.001 - np.rint(reading / 0.001)).max() < 1e-3
    assert (reading[:10] == 0).all()
    holes = reading[20:] == 0
    assert holes[:, 39:41].mean() == pytest.approx(0.5, abs=0.15)
    assert not holes[:, :38].any()
