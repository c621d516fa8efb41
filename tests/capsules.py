"""Pictures of capsules of known length before a wall, by exact intersection of rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.scenes.scene import Stem, cast_stem

CAMERA = Intrinsics(640, 360, 462.0, 462.0, 319.5, 179.5)


@dataclass(frozen=True)
class Capsule:
    """A cylinder with round ends: its axis from the first to the second end's sphere."""

    first_m: tuple[float, float, float]
    second_m: tuple[float, float, float]
    radius_m: float = 0.02

    @property
    def length_m(self) -> float:
        """From end to end."""
        return float(np.linalg.norm(np.subtract(self.second_m, self.first_m))) + 2 * self.radius_m


def lying(
    length_m: float,
    *,
    distance_m: float = 0.5,
    across_m: float = 0.0,
    down_m: float = 0.0,
    tilt_deg: float = 0.0,
    radius_m: float = 0.02,
) -> Capsule:
    """Return a capsule that lies across the view, its second end tilted away from the camera."""
    half = length_m / 2 - radius_m
    tilt = np.deg2rad(tilt_deg)
    along = np.array([half * np.cos(tilt), 0.0, half * np.sin(tilt)])
    middle = np.array([across_m, down_m, distance_m])
    return Capsule(tuple(middle - along), tuple(middle + along), radius_m)


def capsule_capture(
    *capsules: Capsule,
    camera: Intrinsics = CAMERA,
    wall_m: float = 0.8,
    noise_m: float = 0.0005,
    seed: int = 3,
    name: str = "capsules",
) -> Capture:
    """Return a capture of capsules with their masks, depth noise and 1 mm steps as a D435 has."""
    depths = [_depth_of(capsule, camera) for capsule in capsules]
    nearest = np.min(depths, axis=0)
    depth_m = np.minimum(nearest, wall_m)
    noise = np.random.default_rng(seed).normal(0.0, noise_m, depth_m.shape)
    depth_m = np.round(depth_m + noise, 3).astype(np.float32)
    masks = tuple((depth == nearest) & (depth < wall_m) for depth in depths)
    color = np.full((*depth_m.shape, 3), 120, np.uint8)
    color[nearest < wall_m] = (40, 130, 50)
    return Capture(color, depth_m, camera, name, masks=masks, simulated=True)


def _depth_of(capsule: Capsule, camera: Intrinsics) -> NDArray[np.float64]:
    """Return z of a capsule's first point on each ray, infinite where there is none."""
    depth = np.full((camera.height, camera.width), np.inf)
    axis = np.array([capsule.first_m, capsule.second_m])
    if (hit := cast_stem(Stem(axis, capsule.radius_m), camera)) is not None:
        depth[hit.window] = hit.depth_m
    return depth


def pairs_of(captures: Sequence[Capture]) -> list[tuple[NDArray[np.uint8], NDArray[np.uint16]]]:
    """Return colour and depth in millimetres of captures, as files hold them."""
    return [
        (capture.color, np.rint(capture.depth_m * 1000).astype(np.uint16)) for capture in captures
    ]


def with_depth(capture: Capture, depth_m: NDArray[np.floating]) -> Capture:
    """Return a capture with another depth picture, metres."""
    return replace(capture, depth_m=depth_m.astype(np.float32))
