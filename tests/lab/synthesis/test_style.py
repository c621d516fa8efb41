from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.synthesis.arrange import hang, trellis
from cucumbervision_lab.synthesis.assets import Assets
from cucumbervision_lab.synthesis.occluders import Plane
from cucumbervision_lab.synthesis.scenes import Scene
from cucumbervision_lab.synthesis.style import FAR, random_style
from cucumbervision_lab.synthesis.tube import arc_tube

CAMERA = Intrinsics(320, 180, 228.0, 228.0, 160.0, 90.0)
FRUIT = (hang(arc_tube(0.2, 0.02), (0.0, 0.0, 0.5)), hang(arc_tube(0.15, 0.02), (0.1, 0.0, 0.5)))


def test_every_body_gets_a_look() -> None:
    scene = trellis(np.random.default_rng(1), CAMERA, FRUIT)
    style = random_style(np.random.default_rng(2), scene, Assets(), "hanging")
    assert len(style.skins) == 2
    assert len(style.leaf_colors) == len(style.leaf_roles) == len(scene.leaves)
    # Of the four rods two are strings of 1.5 mm.
    assert style.stem_roles == ("string", "string", "stem", "stem")
    assert style.materials == (FAR,)
    assert style == random_style(np.random.default_rng(2), scene, Assets(), "hanging")


def test_fruit_on_a_bench_are_lit_from_off_it() -> None:
    planes = (Plane.facing(0.6, tilt_deg=30.0), Plane.facing(2.0))
    style = random_style(np.random.default_rng(1), Scene(FRUIT, planes=planes), Assets(), "bench")
    assert style.materials[0] != FAR
    assert style.materials[1] == FAR
    # Its upper part leans away: off it is up and towards the camera, at 30 degrees.
    assert style.light.up == pytest.approx((0.0, -0.5, -np.sqrt(0.75)))
    own = random_style(
        np.random.default_rng(1), Scene(FRUIT), Assets(), "bench", up=(1.0, 0.0, 0.0)
    )
    assert own.light.up == (1.0, 0.0, 0.0)


def test_fruit_of_one_plant_are_alike() -> None:
    apart = []
    for seed in range(40):
        skins = random_style(np.random.default_rng(seed), Scene(FRUIT), Assets(), "bench").skins
        apart.append(np.abs(np.subtract(skins[0].base, skins[1].base)).max())
    assert 2 < np.median(apart) < 20
    named = random_style(
        np.random.default_rng(1), Scene(FRUIT), Assets(), "bench", varieties=("pickling", "long")
    )
    assert named.skins[0].warts_per_cm2 >= 1.0 > named.skins[1].warts_per_cm2


def test_planes_of_a_role_are_of_one_make() -> None:
    scene = Scene((), planes=tuple(Plane.facing(z) for z in (0.6, 0.7, 0.8, 3.0)))
    style = random_style(
        np.random.default_rng(3),
        scene,
        Assets(),
        "crate",
        plane_roles=("crate", "crate", "floor", "far"),
    )
    assert style.materials[0] == style.materials[1]
    assert style.material_colors[0] == style.material_colors[1]
    assert style.materials[3] == FAR


def test_unknown_settings_and_roles_are_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(ValueError, match="no setting 'field'"):
        random_style(rng, Scene(()), Assets(), "field")
    with pytest.raises(ValueError, match="no role of a leaf or stem 'rope'"):
        random_style(rng, Scene(()), Assets(), "bench", stem_roles=("rope",))
    with pytest.raises(ValueError, match="no role of a plane 'roof'"):
        random_style(rng, Scene(()), Assets(), "bench", plane_roles=("roof",))
