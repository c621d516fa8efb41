"""Crops of fruit: geometry there and back, and what the planes show."""

from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.arrays import Array, Array32, Mask, Pixels
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.crops import (
    END_PX,
    HEIGHT_PX,
    PLANES,
    WIDTH_PX,
    FruitCrop,
    end_crop,
    fruit_crop,
)
from cucumbervision.fruit.masks import mask_iou

SHAPE = (480, 640)


def _ellipse(middle: tuple[float, float], half: tuple[float, float], degrees: float) -> Mask:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    turn = np.radians(degrees)
    along = (u - middle[0]) * np.cos(turn) + (v - middle[1]) * np.sin(turn)
    across = -(u - middle[0]) * np.sin(turn) + (v - middle[1]) * np.cos(turn)
    return np.asarray((along / half[0]) ** 2 + (across / half[1]) ** 2 <= 1)


def _crop(mask: Mask, **depth: object) -> FruitCrop:
    color = np.zeros((*SHAPE, 3), np.uint8)
    crop = fruit_crop(color, depth.get("depth_m"), mask, depth.get("focal_px"))  # type: ignore[arg-type]
    assert crop is not None
    return crop


def test_the_axis_of_the_mask_lies_level_in_the_middle() -> None:
    crop = _crop(_ellipse((300, 200), (150, 30), 35))
    ends = np.array([300, 200]) + 150 * np.array([[-1], [1]]) * np.array(
        [np.cos(np.radians(35)), np.sin(np.radians(35))]
    )
    placed = crop.to_crop(ends)
    # 300 px along the axis and 45 % more over 256 columns: 1.7 picture pixels each.
    assert crop.step_px == pytest.approx(1.45 * 300 / WIDTH_PX, rel=0.01)
    np.testing.assert_allclose(placed[:, 1], (HEIGHT_PX - 1) / 2, atol=0.7)
    np.testing.assert_allclose(np.ptp(placed[:, 0]), 300 / crop.step_px, atol=0.1)


def test_an_outline_drawn_in_the_crop_returns_to_its_place_in_the_picture() -> None:
    mask = _ellipse((300, 200), (150, 30), 35)
    crop = _crop(mask)
    columns, rows = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    places = crop.to_picture(np.stack([columns.ravel(), rows.ravel()], 1).astype(float))
    turn = np.radians(35)
    along, across = (
        (places - (300, 200))
        @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    ).T
    inside = 1 - np.hypot(along / 150, across / 30)
    back = crop.mask_in_picture(inside.reshape(HEIGHT_PX, WIDTH_PX).astype(np.float32), SHAPE)
    assert mask_iou(back, mask) > 0.98


def test_depth_is_shown_relative_to_the_fruit_in_its_radii() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[220:261, 200:401] = True  # 41 rows: a radius of 21 px, at 0.5 m and 600 px 17.5 mm
    depth = np.where(mask, 0.5, 0.535).astype(np.float32)
    depth[:, :300] = 0
    crop = _crop(mask, depth_m=depth, focal_px=600.0)
    left, right = int(crop.to_crop(np.array([[250.0, 240]]))[0, 0]), None
    right = int(crop.to_crop(np.array([[350.0, 240]]))[0, 0])
    middle = HEIGHT_PX // 2
    assert crop.planes[middle, left, 3:].tolist() == [128, 0, 255]
    assert crop.planes[middle, right, 3:].tolist() == [128, 255, 255]
    # Two radii behind: half of the four that 127.5 steps stand for.
    assert abs(int(crop.planes[2, right, 3]) - 191) <= 1
    assert crop.planes[2, right, 4:].tolist() == [255, 0]


def test_an_empty_mask_gives_no_crop() -> None:
    assert fruit_crop(np.zeros((9, 9, 3), np.uint8), None, np.zeros((9, 9), bool), None) is None


def test_a_single_pixel_and_a_mask_at_the_edge_give_a_crop() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[0, 0] = True
    assert _crop(mask).step_px == 0.25
    mask[:, :20] = True
    assert _crop(mask).planes.shape == (HEIGHT_PX, WIDTH_PX, 6)


CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


RADIUS_M, DISTANCE_M = 0.02, 0.6


GREEN, WALL, LEAF = (40, 140, 40), (90, 90, 90), (200, 200, 30)


def scene(
    angle_deg: float, tip_px: tuple[float, float] = (320.0, 240.0)
) -> tuple[Pixels, Array32, Mask, Array]:
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
