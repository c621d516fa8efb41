"""Crops of fruit: geometry there and back, and what the planes show."""

import numpy as np
import pytest

from cucumbervision.fruit.crops import HEIGHT_PX, WIDTH_PX, FruitCrop, fruit_crop
from cucumbervision.fruit.masks import mask_iou

SHAPE = (480, 640)


def _ellipse(
    middle: tuple[float, float], half: tuple[float, float], degrees: float
) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    turn = np.radians(degrees)
    along = (u - middle[0]) * np.cos(turn) + (v - middle[1]) * np.sin(turn)
    across = -(u - middle[0]) * np.sin(turn) + (v - middle[1]) * np.cos(turn)
    return np.asarray((along / half[0]) ** 2 + (across / half[1]) ** 2 <= 1)


def _crop(mask: np.ndarray[tuple[int, int], np.dtype[np.bool_]], **depth: object) -> FruitCrop:
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
