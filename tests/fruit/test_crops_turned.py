from __future__ import annotations

import numpy as np

from cucumbervision.fruit.crops import PLANES, crop_places, crop_planes


def test_places_run_along_a_direction_and_aside() -> None:
    downwards = crop_places(np.array([10.0, 20.0]), np.array([0.0, 1.0]), 2.0, (2, 3))
    # Rows lead down, columns lead to the left: (0, 1) turned by a quarter.
    assert downwards.tolist() == [
        [[11.0, 18.0], [11.0, 20.0], [11.0, 22.0]],
        [[9.0, 18.0], [9.0, 20.0], [9.0, 22.0]],
    ]


def test_planes_hold_colour_depth_and_mask_and_nothing_outside() -> None:
    color = np.full((4, 6, 3), (10, 20, 30), np.uint8)
    depth_m = np.full((4, 6), 0.5, np.float32)
    depth_m[1, 1], depth_m[1, 2] = 0.54, 0.0  # two radii behind the surface; not read
    mask = np.zeros((4, 6), bool)
    mask[1, 0] = True
    places_px = crop_places(np.array([1.0, 1.0]), np.array([1.0, 0.0]), 1.0, (1, 5))
    planes = crop_planes(color, depth_m, mask, places_px, 1.0, 0.5, 0.02)
    assert planes.shape == (1, 5, PLANES)
    assert planes[0, 1:, :3].tolist() == [[10, 20, 30]] * 4
    assert planes[0, :, 3].tolist() == [128, 128, 191, 128, 128]  # 127.5 * (1 + 2 / 4)
    assert planes[0, :, 4].tolist() == [0, 255, 255, 0, 255]
    assert planes[0, :, 5].tolist() == [0, 255, 0, 0, 0]


def test_without_depth_its_planes_are_empty() -> None:
    color, mask = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), bool)
    places_px = crop_places(np.array([2.0, 2.0]), np.array([1.0, 0.0]), 1.0, (1, 3))
    planes = crop_planes(color, None, mask, places_px, 1.0)
    assert planes[0, :, 3:].tolist() == [[128, 0, 255]] * 3
