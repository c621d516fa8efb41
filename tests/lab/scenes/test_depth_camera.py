from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.scenarios.sensor_statistics import noise_split

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.scenes import depth_camera
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Leaf, Plane, Scene, render

COLOR = Intrinsics(640, 360, 462.0, 462.0, 320.0, 180.0)
CAMERA = D4xx.like(COLOR)
CALM = replace(
    CAMERA, disparity_rms_px=0.0, unit_m=1e-5, subpixel_step_px=1e-4, registration_px=(0.0, 0.0)
)
WALL = Scene((), planes=(Plane.facing(0.6),))


def burst_of(scene: Scene, camera: D4xx, frames: int = 1, seed: int = 5) -> list[np.ndarray]:
    return list(sense(scene, camera, np.random.default_rng(seed), frames))


def test_a_calm_camera_reads_the_exact_depth_of_a_slanted_wall() -> None:
    wall = Scene((), planes=(Plane.facing(0.6, tilt_deg=15.0, turn_deg=-20.0),))
    reading = burst_of(wall, CALM)[0]
    exact = render(wall, COLOR).depth_m
    read = reading > 0
    assert read.mean() > 0.99
    # A colour pixel takes a depth pixel's reading from up to 0.8 colour pixels away.
    slope = max(np.abs(np.diff(exact, axis=0)).max(), np.abs(np.diff(exact, axis=1)).max())
    assert np.abs(reading - exact)[read].max() < 2.5 * slope


@pytest.mark.parametrize("distance_m", [0.4, 0.8])
def test_noise_is_disparity_noise(distance_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_camera, "_CORRELATION_PX", 1.5)
    camera = replace(CAMERA, unit_m=1e-5)
    reading = burst_of(Scene((), planes=(Plane.facing(distance_m),)), camera)[0]
    # sd(z) = z² s / (f B), the depth camera's f being 320 px at 640 wide.
    by_hand = distance_m**2 * camera.disparity_rms_px / (320.0 * 0.05)
    assert reading[reading > 0].std() == pytest.approx(by_hand, rel=0.1)


@pytest.mark.parametrize("fixed", [0.2, 0.7])
def test_the_fixed_share_is_what_frames_have_in_common(
    fixed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(depth_camera, "_CORRELATION_PX", 2.0)
    camera = replace(CAMERA, unit_m=1e-5, fixed_share=fixed)
    assert noise_split(burst_of(WALL, camera, frames=5)) == pytest.approx(fixed, abs=0.04)


def test_the_same_seed_gives_the_same_frames_and_another_does_not() -> None:
    first, again = burst_of(WALL, CAMERA, 2), burst_of(WALL, CAMERA, 2)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert (first[0] != first[1]).any()
    assert (burst_of(WALL, CAMERA, 1, seed=6)[0] != first[0]).any()


def test_readings_are_whole_millimetres_beyond_the_nearest_distance() -> None:
    near = Scene((), planes=(Plane.facing(0.30, turn_deg=30.0),))
    reading = burst_of(near, CAMERA)[0]
    assert np.abs(reading * 1000 - np.rint(reading * 1000)).max() < 1e-3
    assert reading[reading > 0].min() >= CAMERA.min_z_m
    assert (reading == 0).mean() > 0.2


def test_the_shadow_stands_to_the_left_and_is_as_wide_as_both_parallaxes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("_HIDDEN_FILLED", "_SPECKLE"):
        monkeypatch.setattr(depth_camera, name, 0.0)
    board = Leaf(np.array([0.0, 0.0, 0.45]), np.eye(3), 0.06, 0.06)
    scene = Scene((), leaves=(board,), planes=(Plane.facing(0.9),))
    row = burst_of(scene, replace(CALM, foliage_holes=0.0))[0][180]
    centre = 320
    radius = round(0.06 / 0.45 * 462)
    left = np.count_nonzero(row[centre - radius - 60 : centre - radius] == 0)
    right = np.count_nonzero(row[centre + radius : centre + radius + 60] == 0)
    # By hand: (0.05 + 0.015) m seen at 462 px, at 0.45 m less at 0.9 m: 33 px; a few more or
    # less by the border's own gap.
    assert left == pytest.approx(0.065 * 462 * (1 / 0.45 - 1 / 0.9), abs=6)
    assert right < 8


def test_glare_takes_its_share_of_the_fruit() -> None:
    tube = arc_tube(0.2, 0.022).moved(rotation(-80), (0, 0, 0.45))
    scene = Scene((tube,), planes=(Plane.facing(0.5),))
    inner = render(scene, COLOR).mask(0)
    dry, wet = (
        (burst_of(scene, replace(CALM, glare_holes=share))[0][inner] > 0).mean()
        for share in (0.0, 0.2)
    )
    assert dry - wet == pytest.approx(0.2, abs=0.05)
