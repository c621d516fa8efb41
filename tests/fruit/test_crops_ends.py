from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.crops import END_PX, PLANES, end_crop

if TYPE_CHECKING:
    from numpy.typing import NDArray


CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


RADIUS_M, DISTANCE_M = 0.02, 0.6


GREEN, WALL, LEAF = (40, 140, 40), (90, 90, 90), (200, 200, 30)


def scene(
    angle_deg: float, tip_px: tuple[float, float] = (320.0, 240.0)
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_], NDArray[np.float64]]:
    """Draw a fruit of 12 cm that ends at `tip_px` in a direction, and a leaf beyond that end."""
    ahead = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    v, u = np.mgrid[:480, :640].astype(float)
    along = (u - tip_px[0]) * ahead[0] + (v - tip_px[1]) * ahead[1]
    aside = -(u - tip_px[0]) * ahead[1] + (v - tip_px[1]) * ahead[0]
    mask = (along <= 0) & (along > -120) & (np.abs(aside) <= 20)
    leaf = (along > 40) & (along < 70) & (np.abs(aside) <= 60)
    color = np.full((480, 640, 3), WALL, np.uint8)
    color[mask], color[leaf] = GREEN, LEAF
    depth = np.full((480, 640), 1.0, np.float32)
    depth[mask], depth[leaf] = DISTANCE_M - RADIUS_M, DISTANCE_M - 0.04
    # At 0.6 m a pixel is a millimetre.
    pixels = np.array(tip_px) - np.linspace(0, 120, 13)[:, None] * ahead
    axis = np.column_stack([(pixels - (320.0, 240.0)) / 1000, np.full(13, DISTANCE_M)])
    return color, depth, mask, axis


@pytest.mark.parametrize("angle", [0.0, 40.0, 90.0, 200.0, 305.0])
def test_the_fruit_comes_from_the_left_whatever_its_direction(angle: float) -> None:
    color, depth, mask, axis = scene(angle)
    planes = end_crop(color, depth, mask, CAMERA, axis, 2 * RADIUS_M).planes.astype(int)
    # A side of 160 px on 64: 2.5 px each; the radius is 8 of the crop's pixels.
    middle = planes[END_PX // 2]
    assert (middle[2:30, 5] == 255).all()
    assert (middle[34:, 5] == 0).all()
    assert np.abs(middle[4:28, :3] - GREEN).max() < 12
    assert np.abs(middle[50:58, :3] - LEAF).max() < 12
    rows = np.flatnonzero(planes[:, 16, 5])
    assert len(rows) == pytest.approx(16, abs=2)
    # The surface is the reference; the leaf is one radius nearer, the wall far behind.
    assert np.abs(middle[4:28, 3] - 128).max() <= 2
    assert np.abs(middle[50:58, 3] - (127.5 - 127.5 / 4)).max() <= 2
    assert (middle[36:44, 3] == 255).all()


def test_what_has_no_reading_and_what_lies_outside_is_told() -> None:
    color, depth, mask, axis = scene(0, tip_px=(620.0, 240.0))
    depth[:, :560] = 0
    planes = end_crop(color, depth, mask, CAMERA, axis, 2 * RADIUS_M).planes
    middle = planes[END_PX // 2]
    assert (middle[:6, 3:5] == (128, 0)).all()  # the fruit, without readings
    assert (middle[10:28, 4] == 255).all()
    beyond = middle[42:]  # 25 px beyond the end, where the picture ends after 19
    assert (beyond == (114, 114, 114, 128, 0, 0)).all()


def test_shape_is_length_and_radius() -> None:
    color, depth, mask, axis = scene(0)
    aspect, radius = end_crop(color, depth, mask, CAMERA, axis, 2 * RADIUS_M).shape
    assert np.exp(aspect) == pytest.approx(0.12 / 0.02)
    assert np.exp(radius) == pytest.approx(20.0)


def test_an_axis_along_the_view_and_a_speck_give_a_crop() -> None:
    color, depth, mask, axis = scene(0)
    along = np.column_stack([np.zeros((13, 2)), np.linspace(0.6, 0.72, 13)])
    for line, diameter in ((along, 0.04), (np.repeat(axis[:1], 3, axis=0), 0.04), (axis, 0.0)):
        assert end_crop(color, depth, mask, CAMERA, line, diameter).planes.shape[2] == PLANES
