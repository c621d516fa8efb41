import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.datasets.mask_axis import keypoints_of_mask
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
