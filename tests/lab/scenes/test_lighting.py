from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.lighting import Light, ambient_occlusion, light_maps, sun_shadow
from cucumbervision_lab.scenes.scene import Plane, Scene, render
from cucumbervision_lab.scenes.textures import Assets


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
def test_what_faces_up_is_lit_by_the_sky(up: tuple[float, float, float]) -> None:
    sky = np.full((64, 128, 3), 0.05, np.float32)
    sky[:32] = 1.0
    light = Light(up, up=up, environment=0)
    maps = light_maps(np.random.default_rng(1), light, Assets(environments=(sky,)))
    size = len(maps.front)
    at = [round((0.98 * up[i] + 1) * size / 2 - 0.5) for i in (1, 0)]
    assert maps.front[at[0], at[1], 0] == pytest.approx(1.0, abs=0.1)
    assert maps.back[at[0], at[1], 0] < 0.3


CAMERA = Intrinsics(640, 360, 450.0, 450.0, 320.0, 180.0)


FROM_LEFT = Light((-np.sqrt(0.5), 0.0, -np.sqrt(0.5)), sun_strength=1.0)


@pytest.fixture(scope="module")
def lying() -> np.ndarray:
    """An upright fruit, 4 cm thick, on a wall at 0.6 m, its axis in the picture's middle."""
    fruit = arc_tube(0.2, 0.02).moved(rotation(roll_deg=90.0), (0.0, 0.0, 0.58))
    scene = Scene((fruit,), planes=(Plane.facing(0.6),))
    return render(scene, CAMERA).depth_m.astype(np.float32)


def test_the_sun_throws_a_shadow_to_the_other_side(lying: np.ndarray) -> None:
    row = sun_shadow(np.random.default_rng(1), lying, CAMERA, FROM_LEFT)[180]
    # Light falling at 45 degrees grazes the fruit's far side: the shadow's edge on the wall lies
    # at x = r (1 + sqrt 2) - r, for the axis a radius above the wall: 0.0283 m, 21 px beyond it.
    edge = 320 + 450 * 0.02 * np.sqrt(2) / 0.6
    behind = np.s_[round(320 + 450 * 0.02 / 0.58) + 1 : round(edge) - 3]
    assert row[behind].max() < 0.5
    assert row[round(edge) + 20 :].min() > 0.95
    assert row[:295].min() > 0.95


def test_it_is_darker_where_a_fruit_touches_the_ground(lying: np.ndarray) -> None:
    row = ambient_occlusion(lying)[180]
    touching, away = row[320 + 20], row[320 + 150]
    assert touching < 0.8
    assert away > 0.97
    # No bright rim: the last pixels of the fruit are no brighter than its middle.
    assert row[300:320].max() <= row[320] + 0.02
