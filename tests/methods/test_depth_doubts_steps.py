"""Depth in steps as coarse as a fruit, on capsules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.capsules import Capsule, capsule_capture, lying, with_depth

from cucumbervision.capture.frames import Capture
from cucumbervision.methods.depth_doubts import has_coarse_steps
from cucumbervision.methods.flags import Flag
from cucumbervision.run.batch import measure


def is_coarse(capture: Capture, mask: NDArray[np.bool_] | None = None) -> bool:
    outline = capture.masks[0] if mask is None else mask
    return has_coarse_steps(capture.depth_m, capture.depth_m[outline])


@pytest.mark.parametrize("step_m", [0.01, 0.025, 10 / 255])
def test_depth_in_coarse_steps_is_told_and_gives_no_interval(step_m: float) -> None:
    floor = Capsule((-0.3, 0.14, 0.35), (0.3, 0.14, 0.75), 0.1)  # other depths in the picture
    capture = capsule_capture(lying(0.16, distance_m=0.5), floor)
    fruit = capture.masks[0]
    assert not is_coarse(capture, fruit)
    millimetres = with_depth(capture, np.round(capture.depth_m, 3))
    assert not is_coarse(millimetres, fruit)
    coarse = with_depth(capture, np.floor(capture.depth_m / step_m) * step_m)
    assert is_coarse(coarse, fruit)
    (measured,) = measure(replace(coarse, masks=(fruit,)), instances="dataset").fruit
    assert Flag.DEPTH_COARSE in measured.flags
    assert measured.length is None or measured.length.low_m is None
    assert not measured.at_least


def test_a_picture_of_8_bits_saved_with_16_is_told() -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.5), wall_m=0.8)
    eight_bits = np.floor(255 * capture.depth_m / capture.depth_m.max())
    assert is_coarse(with_depth(capture, 0.001 * eight_bits))
    # A camera that reads so near stores tenths of a millimetre.
    assert not is_coarse(with_depth(capture, np.round(0.3 * capture.depth_m, 4)))
