from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision_lab.scenes.colors import Exposure, expose, random_exposure, to_linear

CLEAN = Exposure(blur_px=0.0, shot=0.0, read=0.0, vignette=0.0, sharpen=0.0, quality=0)
GREY = np.full((64, 96, 3), 0.5, np.float32)


def take(linear: np.ndarray, exposure: Exposure) -> np.ndarray:
    return expose(linear, exposure, np.random.default_rng(1))


def test_the_camera_sets_itself_and_a_stop_doubles_the_light() -> None:
    right, dim = take(GREY, CLEAN), take(0.01 * GREY, CLEAN)
    assert np.array_equal(right, dim)
    light = [float(to_linear(take(GREY, replace(CLEAN, stops=s)))[0, 0, 0]) for s in (-1, 0, 1)]
    assert light == pytest.approx([0.1, 0.2, 0.4], rel=0.01)


def test_much_light_rolls_off_to_white() -> None:
    over = take(GREY, replace(CLEAN, stops=5.0))
    assert 235 <= over.min() <= over.max() <= 255
    lamp = GREY.copy()
    lamp[:, 80:] = 40.0
    # Metering for the highlights holds the rest down; metering for the rest lets them clip.
    held, clipped = (take(lamp, replace(CLEAN, highlights=h)) for h in (1.5, 20.0))
    assert held[0, 0, 0] < 60 < 80 < clipped[0, 0, 0]
    assert 230 < held[0, -1, 0] < clipped[0, -1, 0]


def test_noise_has_the_spread_it_is_told() -> None:
    # At 0.2 of full light the variance is shot * 0.2 + read², times what each channel loses and
    # gains by being laid out as a Bayer pattern.
    noisy = replace(CLEAN, shot=0.002, read=0.01)
    wide = np.full((400, 400, 3), 0.2, np.float32)
    light = to_linear(take(wide, noisy))
    spread = light.std(axis=(0, 1)) / np.sqrt(0.002 * 0.2 + 0.01**2)
    assert 0.5 < spread.min() <= spread.max() < 1.3
    # Red is known at every second pixel only: neighbours go together more than green's do.
    red, green = (light[..., c] - light[..., c].mean() for c in (0, 1))
    together = [(n[:, 1:] * n[:, :-1]).mean() / n.var() for n in (red, green)]
    assert together[0] > together[1] > 0


def test_the_same_seed_takes_the_same_picture() -> None:
    exposure = random_exposure(np.random.default_rng(9))
    assert exposure == random_exposure(np.random.default_rng(9))
    first, second = take(GREY, exposure), take(GREY, exposure)
    assert np.array_equal(first, second)
