"""Depth of walls, tables and plants, along the axis and along each pixel's ray."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.capsules import capsule_capture, lying

from cucumbervision.capture.frames import Doubt, depth_along_axis, is_along_ray
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.methods.flags import Flag, is_lower_bound
from cucumbervision.run.results import measure

WIDE = Intrinsics(320, 240, 225.0, 225.0, 159.5, 119.5)
REAL = Path(os.environ.get("CUCUMBERVISION_DATA", "/nowhere")) / "rgbd" / "cucumber_d435"


def stretch(camera: Intrinsics) -> NDArray[np.float64]:
    """Return the distance along each pixel's ray over that along the axis."""
    x, y = camera.rays(np.arange(camera.width)[None, :], np.arange(camera.height)[:, None])
    return np.asarray(np.sqrt(1 + x**2 + y**2))


def wall(camera: Intrinsics, slope: float, noise: float) -> NDArray[np.float32]:
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
