from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.mask_codes import fill_polygon
from cucumbervision_lab.data.labels import keypoints_of_mask, one_polygon
from cucumbervision_lab.scenes.bodies import random_fruit, rotation
from cucumbervision_lab.scenes.scene import Scene, truth_of

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


CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


@pytest.mark.parametrize("seed", range(10))
def test_they_come_near_the_exact_ones_of_a_fruit_seen_from_the_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = random_fruit(rng, 0.25).moved(rotation(-90 + rng.normal(0, 10)), (0.0, 0.0, 0.6))
    (truth,) = truth_of(Scene((body,)), CAMERA)
    points = keypoints_of_mask(truth.visible, "up")
    assert points is not None
    off = np.linalg.norm(points[:, :2] - truth.keypoints_px, axis=1)
    # 25 cm are 250 px here.
    assert off.max() < 0.04 * 250
    assert (points[:, 2] == 2).all()


def test_the_word_says_which_end_is_last() -> None:
    mask = np.zeros((60, 60), bool)
    mask[5:55, 25:35] = True
    up, down = keypoints_of_mask(mask, "up"), keypoints_of_mask(mask, "down-right")
    assert up is not None
    assert down is not None
    np.testing.assert_allclose(up, down[::-1])
    assert up[4, 1] < up[0, 1]


def test_round_small_and_hollow_outlines_have_none() -> None:
    v, u = np.mgrid[:80, :80]
    assert keypoints_of_mask((u - 40) ** 2 + (v - 40) ** 2 < 900, "up") is None
    small = np.zeros((20, 20), bool)
    small[5:10, 2:17] = True
    assert keypoints_of_mask(small, "left") is None
    ring = np.hypot((u - 40) / 35, (v - 40) / 15)
    assert keypoints_of_mask((ring < 1) & (ring > 0.6), "left") is None


def test_an_unknown_word_is_refused() -> None:
    with pytest.raises(ValueError, match="sideways"):
        keypoints_of_mask(np.ones((20, 20), bool), "sideways")
