from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.camera import depth_quality
from cucumbervision.capture.frames import Capture, FusedBurst, fuse_burst, moved_px
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.selector import measure_fruit
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Kind, Scene, render

CAMERA = Intrinsics(848, 480, 616.0, 616.0, 423.5, 239.5)
LENGTHS_M = (0.24, 0.18)
BLOTS = np.random.default_rng(1).uniform(-25, 25, (200, 1000))  # of 4 mm, on all surfaces


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame of a walk along two hanging fruit, and the fruit's masks."""

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    masks: tuple[NDArray[np.bool_], ...]


def seen_from(along_m: float, number: int) -> Seen:
    at = ((-0.05, 0.0, 0.55), (0.13, 0.03, 0.62))
    tubes = [
        arc_tube(length_m, 0.02, 2.0, neck=0.2).moved(rotation(-75.0), (x - along_m, y, z))
        for length_m, (x, y, z) in zip(LENGTHS_M, at, strict=True)
    ]
    scene = Scene.of(*tubes, backdrop_m=0.9)
    view, rng = render(scene, CAMERA), np.random.default_rng([number, 7])
    [depth_m] = sense(scene, D4xx.like(CAMERA), rng, 1)
    rows, columns = np.indices(view.depth_m.shape)
    x, y = CAMERA.rays(columns, rows)
    blot = np.floor(250 * (y * view.depth_m)), np.floor(250 * (x * view.depth_m + along_m))
    color: Any = np.where((view.kind == Kind.FRUIT)[..., None], (60.0, 120.0, 50.0), (90, 90, 80))
    color = color + BLOTS[blot[0].astype(int) % 200, blot[1].astype(int) % 1000][..., None]
    color = np.clip(color + rng.normal(0, 3, color.shape), 0, 255).astype(np.uint8)
    return Seen(color, depth_m, tuple(view.mask(k) for k in range(2)))


def burst(speed_m_s: float, rate_hz: float) -> tuple[list[Seen], FusedBurst]:
    frames = [seen_from(k * speed_m_s / rate_hz, k) for k in range(5)]
    return frames, fuse_burst([f.color for f in frames], [f.depth_m for f in frames])


def lengths_m(frames: list[Seen], fused: FusedBurst) -> list[float]:
    capture = Capture(fused.color, fused.depth_m, CAMERA, "walk")
    fruit = [
        measure_fruit(capture, Instance(box_of_mask(mask), mask=mask))
        for mask in frames[fused.burst_frame].masks
    ]
    return [one.length.value_m for one in fruit if one.length is not None]


@pytest.mark.parametrize("rate_hz", [6.0, 30.0])
def test_a_burst_of_a_walk_is_measured_from_the_frames_that_agree(rate_hz: float) -> None:
    frames, fused = burst(0.36, rate_hz)
    assert fused.burst_size == 1
    assert fused.moved_px > 20
    # Of all five frames they are 40 and 27 cm.
    assert lengths_m(frames, fused) == pytest.approx(LENGTHS_M, rel=0.04)
    quality = depth_quality(Capture(**vars(fused), intrinsics=CAMERA, name="walk"))
    assert (quality.verdict, quality.advice) == ("moving", "The camera moves: hold still")


def test_a_burst_that_stands_still_is_fused_as_it_was() -> None:
    frames, fused = burst(0.0, 30.0)
    assert (fused.burst_size, round(fused.moved_px)) == (5, 0)
    assert lengths_m(frames, fused) == pytest.approx(LENGTHS_M, rel=0.02)
    quality = depth_quality(Capture(**vars(fused), intrinsics=CAMERA, name="still"))
    assert quality.advice == "Good distance and depth"


def test_a_hand_that_trembles_keeps_its_burst() -> None:
    _, fused = burst(0.02, 30.0)
    assert fused.burst_size == 5


def test_frames_before_a_jolt_are_left_out() -> None:
    still, after = seen_from(0.0, 0), seen_from(0.05, 1)
    sharp = np.clip(1.2 * still.color.astype(float) - 20, 0, 255).astype(np.uint8)
    colors = [after.color, still.color, sharp]
    fused = fuse_burst(colors, [after.depth_m, still.depth_m, still.depth_m])
    assert (fused.burst_frame, fused.burst_size) == (2, 2)
    np.testing.assert_array_equal(fused.depth_m, still.depth_m)


def test_a_plain_wall_does_not_say_that_it_moved() -> None:
    rng = np.random.default_rng(4)
    walls = [np.clip(rng.normal(90, 3, (480, 848, 3)), 0, 255).astype(np.uint8) for _ in "ab"]
    assert moved_px(walls[0], walls) == [0.0, 0.0]


def test_a_brighter_frame_has_not_moved() -> None:
    color = seen_from(0.0, 0).color
    brighter = np.clip(1.25 * color, 0, 255).astype(np.uint8)
    assert moved_px(color, [brighter]) == [pytest.approx(0.0, abs=0.5)]
