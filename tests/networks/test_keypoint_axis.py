"""Keypoints on the axis of an outline: drawn bodies with known ends, stalks, hidden ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance
from cucumbervision.networks.keypoint_axis import (
    body_without_stalk,
    keypoints_between,
    place_keypoints,
)
from cucumbervision_lab.scenes.bodies import random_fruit, rotation
from cucumbervision_lab.scenes.scene import Scene, truth_of

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
BOX = np.array([9.5, 9.5, 109.5, 29.5])


def _found(mask: np.ndarray, points: np.ndarray) -> Instance:
    """What a pose network and SAM give."""
    keypoints = np.column_stack([points, np.full(5, 0.9)])
    return Instance(BOX, 0.9, mask=mask, keypoints=keypoints, input_size_px=640)


def _level(first_px: float, last_px: float, v_px: float = 20.0) -> np.ndarray:
    return np.column_stack([np.linspace(first_px, last_px, 5), np.full(5, v_px)])


@pytest.mark.parametrize("seed", range(6))
def test_points_of_a_network_come_nearer_on_the_axis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = random_fruit(rng, 0.25).moved(rotation(-90 + rng.normal(0, 10)), (0.0, 0.0, 0.6))
    (truth,) = truth_of(Scene((body,)), CAMERA)
    true = truth.keypoints_px
    # 25 cm are 250 px here; a network errs by 4 % of the length along the fruit.
    rough = true + rng.normal(0, 0.04 * 250, true.shape) * (1, 0.3)
    (placed,) = place_keypoints([_found(truth.visible, rough)])
    assert placed.keypoints is not None
    off = np.linalg.norm(placed.keypoints[:, :2] - true, axis=1)
    assert off.max() < 0.025 * 250
    between = keypoints_between(truth.visible, true[[0, 4]])
    assert between is not None
    np.testing.assert_allclose(between[[0, 4]], true[[0, 4]], atol=1e-6)
    assert np.linalg.norm(between - true, axis=1).max() < 0.02 * 250


def test_a_stalk_is_no_part_of_the_fruit() -> None:
    mask = np.zeros((40, 120), bool)
    mask[10:30, 10:90] = True
    mask[19:22, 90:110] = True
    body = body_without_stalk(mask)
    assert body is not None
    assert body[20, 10:90].all()
    assert not body[:, 92:].any()
    # From the stem end on the left of the network's order to the blossom end: the order stays.
    (placed,) = place_keypoints([_found(mask, _level(96.0, 13.0))])
    assert placed.keypoints is not None
    np.testing.assert_allclose(placed.keypoints[:, 0], [89.5, 69.7, 49.75, 29.8, 10], atol=1.0)
    np.testing.assert_allclose(placed.keypoints[:, 1], 19.5, atol=0.6)
    assert placed.keypoints[:, 2].tolist() == [0.9] * 5


def test_an_end_that_something_hides_stays_where_the_network_saw_it() -> None:
    mask = np.zeros((40, 200), bool)
    mask[10:30, 10:120] = True  # a leaf hides the rest, to 160
    (placed,) = place_keypoints([_found(mask, _level(14.0, 160.0, 19.5))])
    assert placed.keypoints is not None
    np.testing.assert_allclose(placed.keypoints[[0, 4], 0], [10, 160], atol=0.6)


def test_what_people_gave_and_what_has_no_axis_stays() -> None:
    mask = np.zeros((40, 120), bool)
    mask[10:30, 10:90] = True
    given = replace(_found(mask, _level(15.0, 80.0)), input_size_px=None)
    ball = _found(np.hypot(*np.mgrid[-20:20, -60:60]) < 15, _level(45.0, 75.0))
    far = _found(mask, _level(30.0, 60.0))
    bare = replace(far, mask=None)
    nowhere = _found(np.zeros_like(mask), _level(15.0, 80.0))
    for one in (given, ball, far, bare, nowhere):
        (placed,) = place_keypoints([one])
        assert placed is one


def test_known_ends_help_no_outline_without_an_axis() -> None:
    v, u = np.mgrid[:80, :80]
    ends = [[40.0, 10.0], [40.0, 70.0]]
    assert keypoints_between((u - 40) ** 2 + (v - 40) ** 2 < 900, ends) is None
    ring = np.hypot(u - 40, (v - 40) / 2)
    hollow = (ring < 19) & (ring > 12)
    assert keypoints_between(hollow, ends) is None
