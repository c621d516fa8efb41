from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from cucumbervision.perception.masks import box_of_mask, fill_polygon
from cucumbervision_lab.datasets.polygons import (
    crosses_itself,
    join_parts,
    one_polygon,
)

masks = hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24))


def without_holes(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What cannot be reached from outside in four directions, by flooding the background."""
    padded = np.pad(mask, 1).astype(np.uint8)
    _, labels = cv2.connectedComponents(1 - padded, connectivity=4)
    return np.asarray(labels[1:-1, 1:-1] != labels[0, 0])


def drawn(mask: NDArray[np.bool_], polygon: NDArray[np.float64], digits: int) -> NDArray[np.bool_]:
    size = np.array(mask.shape[::-1])
    shares = np.round(polygon / size, digits)
    return fill_polygon(shares * size, *mask.shape)


@settings(deadline=None, max_examples=200)
@given(masks)
def test_one_polygon_of_all_parts_gives_the_mask_back(mask: NDArray[np.bool_]) -> None:
    assume(mask.any())
    polygon = one_polygon(mask, min_part_px=0)
    assert polygon is not None
    assert (drawn(mask, polygon, 6) == without_holes(mask)).all()
    assert not crosses_itself(np.round(polygon / 1280, 6) * 1280)


def test_a_bridge_crosses_no_outline_of_long_straight_runs() -> None:
    # The corners of the fork are far from the speck between its prongs; a bridge from corner to
    # corner would go through a prong.
    mask = np.zeros((40, 90), bool)
    mask[2:6, 2:88] = mask[34:38, 2:88] = mask[2:38, 2:6] = True
    mask[10:14, 40:44] = mask[18:22, 50:54] = mask[26:30, 60:64] = True
    polygon = one_polygon(mask, min_part_px=0)
    assert polygon is not None
    assert not crosses_itself(polygon)
    assert (fill_polygon(polygon, *mask.shape) == mask).all()


@settings(deadline=None, max_examples=60)
@given(masks)
def test_a_polygon_reaches_exactly_to_the_masks_box(mask: NDArray[np.bool_]) -> None:
    assume(mask.any())
    polygon = one_polygon(mask, min_part_px=0)
    assert polygon is not None
    points = polygon - 0.5
    edges = [*points.min(axis=0), *points.max(axis=0)]
    assert edges == box_of_mask(mask).tolist()


@settings(deadline=None, max_examples=20)
@given(st.floats(0, np.pi), st.floats(4, 30))
def test_the_polygon_of_a_turned_fruit_has_few_points(angle: float, width: float) -> None:
    mask = np.zeros((240, 320), np.uint8)
    box = cv2.boxPoints(((160.0, 120.0), (200.0, width), np.rad2deg(angle)))
    cv2.fillPoly(mask, [np.rint(box).astype(np.int32)], 1)
    outline = one_polygon(mask > 0)
    assert outline is not None
    edge = np.count_nonzero(mask[1:] != mask[:-1]) + np.count_nonzero(mask[:, 1:] != mask[:, :-1])
    assert len(outline) <= edge
    assert (fill_polygon(outline, *mask.shape) == (mask > 0)).all()


def test_specks_are_left_out_but_never_the_only_part() -> None:
    mask = np.zeros((40, 60), bool)
    mask[5:15, 5:25] = True
    mask[5:15, 30:50] = True
    whole = mask.copy()
    mask[30:32, 30:33] = True
    polygon = one_polygon(mask)
    assert polygon is not None
    assert (fill_polygon(polygon, 40, 60) == whole).all()
    small = np.zeros((40, 60), bool)
    small[3, 3] = True
    polygon = one_polygon(small)
    assert polygon is not None
    assert (fill_polygon(polygon, 40, 60) == small).all()


def test_parts_are_joined_at_their_nearest_points() -> None:
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    joined = join_parts([square, square + np.array([9, 0]), square + np.array([3, 0])])
    steps = np.hypot(*np.diff(np.vstack([joined, joined[:1]]), axis=0).T)
    # Two bridges, there and back: 2 from the first to the third, 5 from there to the second.
    assert sorted(steps[steps > 1.5]) == [2, 2, 5, 5]


@pytest.mark.parametrize(
    ("points", "crosses"),
    [
        ([(0, 0), (10, 0), (10, 10), (0, 10)], False),
        ([(0, 0), (10, 10), (10, 0), (0, 10)], True),
        # A vertex on another edge touches it.
        ([(0, 0), (10, 0), (10, 10), (5, 0), (0, 10)], False),
        # One that goes through by half a pixel crosses.
        ([(0, 0), (10, 0), (10, 10), (5, -0.5), (0, 10)], True),
        ([(0, 0), (10, 0), (0, 5)], False),
    ],
)
def test_crossing(points: list[tuple[float, float]], crosses: bool) -> None:
    assert crosses_itself(np.array(points, np.float64)) is crosses
