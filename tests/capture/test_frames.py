from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.capsules import capsule_capture, lying

from cucumbervision.arrays import Array, Array32, Mask, Pixels
from cucumbervision.capture.camera import depth_quality
from cucumbervision.capture.frames import (
    Capture,
    Doubt,
    FusedBurst,
    depth_along_axis,
    fuse_burst,
    is_along_ray,
    median_depth,
    moved_px,
    sharpness,
)
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.errors import CaptureError
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.flags import Flag, is_lower_bound
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.run.batch import measure
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Kind, Scene, render


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"color": np.zeros((48, 64), np.uint8)}, "colour is uint8 .48, 64."),
        ({"color": np.zeros((48, 64, 3), np.uint16)}, "colour is uint16"),
        ({"depth_m": np.zeros((48, 64))}, "depth is float64"),
        ({"depth_m": np.zeros((48, 64, 1), np.float32)}, "depth is float32 .48, 64, 1."),
        ({"depth_m": np.zeros((48, 60), np.float32)}, "colour 64x48, depth 60x48"),
        ({"masks": (np.zeros((24, 32), bool),)}, "mask 0 32x24"),
        ({"intrinsics": Intrinsics(32, 24, 30, 30, 16, 12)}, "the intrinsics are for 32x24"),
        ({"gravity": (0.0, 0.0, 0.0)}, "gravity .0.0, 0.0, 0.0. is no direction"),
        ({"gravity": (0.0, np.nan, 1.0)}, "is no direction"),
    ],
)
def test_parts_that_disagree(capture: Capture, change: dict[str, Any], words: str) -> None:
    with pytest.raises(CaptureError, match=words):
        replace(capture, **change)


def test_pixels_that_a_masked_array_leaves_out_are_no_readings() -> None:
    depth = np.ma.masked_greater(np.array([[0.5, 0.5, 4.0, 4.0]] * 4), 1.0)
    matrix = np.array([[4.0, 0, 1.9], [0, 4, 1.9], [0, 0, 1]])
    read = Capture.from_arrays(np.zeros((4, 4, 3), np.uint8), depth, matrix)
    assert read.depth_m.tolist() == [[0.5, 0.5, 0.0, 0.0]] * 4


GREY = np.full((2, 3, 3), 90, np.uint8)


def stack(*values: list[float]) -> list[Any]:
    """One frame a list, each of one row."""
    return [np.array([v], np.float32) for v in values]


def test_median_of_valid_readings_by_hand() -> None:
    nan = float("nan")
    # A column a pixel: all valid; two holes; NaN and too near; only one; too far; none.
    frames = stack(
        [0.50, 0.0, nan, 0.0, 9.0, 0.0],
        [0.52, 0.50, 0.40, 0.0, 0.50, 0.05],
        [0.51, 0.0, 0.42, 0.0, 9.0, 5.01],
        [0.90, 0.60, 0.09, 0.70, 0.75, nan],
        [0.53, 0.55, 0.44, 0.0, 9.0, np.inf],
    )
    # Of two readings the mean: (0.50 + 0.75) / 2.
    expected = np.array([[0.52, 0.55, 0.42, 0.70, 0.625, 0.0]], np.float32)
    np.testing.assert_array_equal(median_depth(frames), expected)


def test_laplacian_variance_by_hand() -> None:
    # One bright pixel of 10 in the middle of 5x5 zeros: the Laplacian is -40 there, 10 at its
    # four neighbours: mean 0, variance (1600 + 4 * 100) / 25.
    spot = np.zeros((5, 5, 3), np.uint8)
    spot[2, 2] = 10
    assert sharpness(spot) == pytest.approx(80.0)


def test_sharpest_color_first_of_equals() -> None:
    edge = GREY.copy()
    edge[:, 1:] = 200
    soft = GREY.copy()
    soft[:, 1:] = 120
    depths = [np.full((2, 3), 0.5, np.float32)] * 4
    fused = fuse_burst([GREY, soft, edge, edge], depths)
    assert fused.burst_frame == 2
    np.testing.assert_array_equal(fused.color, edge)


@pytest.mark.parametrize(
    ("colors", "depths"),
    [
        ([], []),
        ([GREY], []),
        ([GREY], [np.ones((3, 3), np.float32)]),
        ([GREY, GREY[:1]], [np.ones((2, 3), np.float32)] * 2),
    ],
)
def test_what_is_no_burst_is_refused(colors: list[Any], depths: list[Any]) -> None:
    with pytest.raises(CaptureError, match="burst"):
        fuse_burst(colors, depths)


WIDE = Intrinsics(320, 240, 225.0, 225.0, 159.5, 119.5)
REAL = Path(os.environ.get("CUCUMBERVISION_DATA", "/nowhere")) / "rgbd" / "cucumber_d435"


def stretch(camera: Intrinsics) -> Array:
    """Return the distance along each pixel's ray over that along the axis."""
    x, y = camera.rays(np.arange(camera.width)[None, :], np.arange(camera.height)[:, None])
    return np.asarray(np.sqrt(1 + x**2 + y**2))


def wall(camera: Intrinsics, slope: float, noise: float) -> Array32:
    """Return the depth of a wall that recedes to the right, with relative noise."""
    x, _ = camera.rays(np.arange(camera.width)[None, :], np.zeros((camera.height, 1)))
    shape = camera.height, camera.width
    depth_m = 0.8 / (1 - slope * np.broadcast_to(x, shape))
    return (depth_m * np.random.default_rng(1).normal(1, noise, shape)).astype(np.float32)


@pytest.mark.parametrize("slope", [0.0, 0.4])
@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_a_wall_tells_the_direction(slope: float, noise: float) -> None:
    depth_m = wall(WIDE, slope, noise)
    assert not is_along_ray(depth_m, WIDE)
    assert is_along_ray((depth_m * stretch(WIDE)).astype(np.float32), WIDE)


def test_half_of_the_wall_may_be_hidden_or_unread() -> None:
    depth_m = (wall(WIDE, 0.1, 0.003) * stretch(WIDE)).astype(np.float32)
    depth_m[:, :60] = 0
    depth_m[60:180, 120:260] *= np.random.default_rng(2).uniform(0.5, 0.9, (120, 140))
    assert is_along_ray(depth_m, WIDE)


def test_where_nothing_is_flat_or_the_view_is_narrow_nothing_is_told() -> None:
    rng = np.random.default_rng(3)
    leaves_m = rng.uniform(0.5, 1.5, (24, 32)).repeat(10, 0).repeat(10, 1).astype(np.float32)
    assert not is_along_ray(leaves_m, WIDE)
    assert not is_along_ray((leaves_m * stretch(WIDE)).astype(np.float32), WIDE)
    narrow = replace(WIDE, fx_px=2250.0, fy_px=2250.0)
    assert not is_along_ray((wall(narrow, 0, 0) * stretch(narrow)).astype(np.float32), narrow)
    assert not is_along_ray(np.full((240, 320), np.inf, np.float32), WIDE)
    assert not is_along_ray(np.zeros((240, 320), np.float32), WIDE)


def test_a_fruit_of_such_depth_is_flagged_and_read_rightly_it_is_not() -> None:
    capture = capsule_capture(lying(0.2, distance_m=0.5), wall_m=0.9)
    along_ray_m = (capture.depth_m * stretch(capture.intrinsics)).astype(np.float32)
    wrong = replace(capture, depth_m=along_ray_m)
    assert wrong.doubts == (Doubt.DEPTH_ALONG_RAY,)
    (fruit,) = measure(wrong, instances="dataset").fruit
    assert Flag.DEPTH_ALONG_RAY in fruit.flags
    assert not is_lower_bound(fruit.flags)
    right = replace(wrong, depth_m=depth_along_axis(along_ray_m, capture.intrinsics))
    assert right.doubts == ()
    assert right.depth_m == pytest.approx(capture.depth_m, abs=1e-5)


@pytest.mark.skipif(not REAL.exists(), reason="no real captures")
@pytest.mark.parametrize(("place", "shows_plane"), [("on_grid", True), ("on_plant", False)])
def test_real_captures_are_not_doubted_and_boards_tell(place: str, shows_plane: bool) -> None:
    reading = ReadOptions(intrinsics=REAL / "intrinsics.json")
    captures = [item.load() for item in open_source(REAL / place, reading)]
    assert captures
    for capture in captures:
        assert capture.doubts == ()
        wrong_m = (capture.depth_m * stretch(capture.intrinsics)).astype(np.float32)
        assert is_along_ray(wrong_m, capture.intrinsics) == shows_plane


CAMERA = Intrinsics(848, 480, 616.0, 616.0, 423.5, 239.5)
LENGTHS_M = (0.24, 0.18)
BLOTS = np.random.default_rng(1).uniform(-25, 25, (200, 1000))  # of 4 mm, on all surfaces


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame of a walk along two hanging fruit, and the fruit's masks."""

    color: Pixels
    depth_m: Array32
    masks: tuple[Mask, ...]


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
    walls = np.random.default_rng(4).normal(90, 3, (2, 480, 848, 3)).clip(0, 255).astype(np.uint8)
    assert moved_px(walls[0], list(walls)) == [0.0, 0.0]
    walls[0], walls[0, :3, :3] = 90, 250  # its only corner lies at the border
    assert moved_px(walls[0], [walls[1]]) == [0.0]


def test_a_brighter_frame_has_not_moved() -> None:
    color = seen_from(0.0, 0).color
    brighter = np.clip(1.25 * color, 0, 255).astype(np.uint8)
    assert moved_px(color, [brighter]) == [pytest.approx(0.0, abs=0.5)]
