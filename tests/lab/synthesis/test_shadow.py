from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.synthesis.light import Light
from cucumbervision_lab.synthesis.occluders import Plane
from cucumbervision_lab.synthesis.scenes import Scene, look
from cucumbervision_lab.synthesis.shadow import corners, spots, sun_shadow
from cucumbervision_lab.synthesis.tube import arc_tube, rotation

CAMERA = Intrinsics(640, 360, 450.0, 450.0, 320.0, 180.0)
FROM_LEFT = Light((-np.sqrt(0.5), 0.0, -np.sqrt(0.5)), sun_strength=1.0)


@pytest.fixture(scope="module")
def lying() -> np.ndarray:
    """An upright fruit, 4 cm thick, on a wall at 0.6 m, its axis in the picture's middle."""
    fruit = arc_tube(0.2, 0.02).moved(rotation(roll_deg=90.0), (0.0, 0.0, 0.58))
    scene = Scene((fruit,), planes=(Plane.facing(0.6),))
    return look(scene, CAMERA).depth_m.astype(np.float32)


def test_the_sun_throws_a_shadow_to_the_other_side(lying: np.ndarray) -> None:
    row = sun_shadow(np.random.default_rng(1), lying, CAMERA, FROM_LEFT)[180]
    # Light falling at 45 degrees grazes the fruit's far side: the shadow's edge on the wall lies
    # at x = r (1 + sqrt 2) - r, for the axis a radius above the wall: 0.0283 m, 21 px beyond it.
    edge = 320 + 450 * 0.02 * np.sqrt(2) / 0.6
    behind = np.s_[round(320 + 450 * 0.02 / 0.58) + 1 : round(edge) - 3]
    assert row[behind].max() < 0.5
    assert row[round(edge) + 20 :].min() > 0.95
    assert row[:295].min() > 0.95


def test_a_bare_wall_has_no_shadow() -> None:
    wall = np.full((360, 640), 0.6, np.float32)
    lit = sun_shadow(np.random.default_rng(1), wall, CAMERA, FROM_LEFT)
    assert lit.shape == wall.shape
    assert lit.min() == pytest.approx(1.0, abs=1e-5)
    assert corners(wall).min() == pytest.approx(1.0, abs=1e-4)


def test_it_is_darker_where_a_fruit_touches_the_ground(lying: np.ndarray) -> None:
    row = corners(lying)[180]
    touching, away = row[320 + 20], row[320 + 150]
    assert touching < 0.8
    assert away > 0.97
    # No bright rim: the last pixels of the fruit are no brighter than its middle.
    assert row[300:320].max() <= row[320] + 0.02
    assert np.allclose(corners(lying, 0.0), 1.0)


def test_leaves_out_of_sight_take_their_share_of_the_sun() -> None:
    wall = np.full((360, 640), 0.6, np.float32)
    light = Light(FROM_LEFT.sun, shade=0.7, spot_m=0.05)
    seen = spots(np.random.default_rng(4), wall, CAMERA, light)
    assert seen.min() == pytest.approx(0.3, abs=1e-5)
    assert seen.max() == pytest.approx(1.0, abs=1e-5)
    assert 0.1 < (seen < 0.4).mean() < 0.9
