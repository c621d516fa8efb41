import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.datasets.mask_axis import keypoints_between, keypoints_of_mask
from cucumbervision_lab.synthesis.bodies import random_fruit
from cucumbervision_lab.synthesis.placing import place_hanging
from cucumbervision_lab.synthesis.scene import Scene, truth_of

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


@pytest.mark.parametrize("seed", range(10))
def test_they_come_near_the_exact_ones_of_a_fruit_seen_from_the_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = place_hanging(random_fruit(rng, 0.25), (0.0, 0.0, 0.6), roll_deg=-90 + rng.normal(0, 10))
    (truth,) = truth_of(Scene((body,)), CAMERA)
    points = keypoints_of_mask(truth.visible, "up")
    assert points is not None
    off = np.linalg.norm(points[:, :2] - truth.keypoints_px, axis=1)
    # 25 cm are 250 px here.
    assert off.max() < 0.04 * 250
    assert (points[:, 2] == 2).all()


@pytest.mark.parametrize("seed", range(10))
def test_between_known_ends_they_come_nearer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = place_hanging(random_fruit(rng, 0.25), (0.0, 0.0, 0.6), roll_deg=-90 + rng.normal(0, 10))
    (truth,) = truth_of(Scene((body,)), CAMERA)
    points = keypoints_between(truth.visible, truth.keypoints_px[[0, 4]])
    assert points is not None
    np.testing.assert_allclose(points[[0, 4], :2], truth.keypoints_px[[0, 4]], atol=1e-6)
    assert np.linalg.norm(points[:, :2] - truth.keypoints_px, axis=1).max() < 0.02 * 250


def test_a_stalk_in_the_outline_is_not_counted() -> None:
    mask = np.zeros((40, 120), bool)
    mask[10:30, 10:90] = True
    mask[19:21, 90:110] = True
    points = keypoints_between(mask, [[10.0, 19.5], [90.0, 19.5]])
    assert points is not None
    np.testing.assert_allclose(points[:, 0], [10, 30, 50, 70, 90], atol=0.5)
    np.testing.assert_allclose(points[:, 1], 19.5, atol=0.5)


def test_the_word_says_which_end_is_last() -> None:
    mask = np.zeros((60, 60), bool)
    mask[5:55, 25:35] = True
    up, down = keypoints_of_mask(mask, "up"), keypoints_of_mask(mask, "down-right")
    assert up is not None
    assert down is not None
    np.testing.assert_allclose(up, down[::-1])
    assert up[4, 1] < up[0, 1]


def test_a_word_across_the_fruit_tells_nothing() -> None:
    mask = np.zeros((60, 60), bool)
    mask[5:55, 25:35] = True
    assert keypoints_of_mask(mask, "left") is None


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


def test_known_ends_help_no_outline_without_an_axis() -> None:
    v, u = np.mgrid[:80, :80]
    ends = [[40.0, 10.0], [40.0, 70.0]]
    assert keypoints_between((u - 40) ** 2 + (v - 40) ** 2 < 900, ends) is None
    ring = np.hypot(u - 40, (v - 40) / 2)
    hollow = (ring < 19) & (ring > 12)
    assert keypoints_between(hollow, ends) is None
