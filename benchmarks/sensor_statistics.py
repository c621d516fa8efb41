"""Compare the simulated depth camera with real frames, by the same measures.

    python benchmarks/sensor_statistics.py DATA_FOLDER [--foliage DEPTH.png]

DATA_FOLDER holds BOP scenes of a body lying on a plain ground (`rgb/`, `depth/`, `mask_visib/`).
For each real frame a twin is drawn: the ground as fitted beside the mask, and on it a straight
tapered body of the mask's outline. DEPTH.png is a 16-bit depth picture of a canopy in millimetres,
compared with drawn trellises. All that is printed is measured alike on both.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision_lab.synthesis.bodies import Tube, random_fruit
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.placing import place_hanging, trellis
from cucumbervision_lab.synthesis.raycast import Plane, cast_plane
from cucumbervision_lab.synthesis.scene import Scene, render
from cucumbervision_lab.synthesis.sensor_statistics import (
    WINDOW_PX,
    EdgeProfile,
    edge_profile,
    fill_inside,
    noise_split,
    plane_residuals,
    residual_at,
    surface_residual,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture

DISTANCES_M = (0.38, 0.47, 0.56)
OTHER_WINDOWS_PX = (9, 15, 41)
WALLS = 3
BALLS = 400


@dataclass(frozen=True, eq=False)
class Pair:
    """A frame's depth, ground and mask, and its twin's."""

    real: tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]
    twin: tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]


def fit_ground(capture: Capture, mask: NDArray[np.bool_]) -> Plane:
    """Fit a plane to the readings in a ring round the mask, by iterated trimming."""
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    v, u = np.nonzero((away > 18) & (away < 45) & valid_depth(capture.depth_m))
    x, y = capture.intrinsics.rays(u, v)
    z = capture.depth_m[v, u].astype(float)
    points = np.stack([x * z, y * z, z], axis=1)
    keep = np.ones(len(points), bool)
    for _ in range(8):
        middle = points[keep].mean(axis=0)
        normal = np.linalg.svd(points[keep][::7] - middle, full_matrices=False)[2][2]
        off = np.abs((points - middle) @ normal)
        keep = off < max(3 * np.median(off), 0.002)
    return Plane(middle, normal)


def body_on(ground: Plane, mask: NDArray[np.bool_], camera: Intrinsics) -> Tube:
    """Lay a straight body of the mask's widths on the ground."""
    v, u = np.nonzero(mask)
    pixels = np.stack([u, v], axis=1).astype(float)
    middle = pixels.mean(axis=0)
    along = np.linalg.svd(pixels[::11] - middle, full_matrices=False)[2][0]
    run = (pixels - middle) @ along
    aside = (pixels - middle) @ np.array([-along[1], along[0]])
    # The mask's outline may be notched by a neighbour: a smooth profile of the widths will do.
    edges = np.linspace(run.min(), run.max(), 41)
    centres, half = [], []
    for low, high in pairwise(edges.tolist()):
        here = aside[(run >= low) & (run < high)]
        half.append(np.ptp(here) / 2 if len(here) > 1 else 1.0)
        centres.append(here.mean() if len(here) else 0.0)
    at = (edges[:-1] + edges[1:]) / 2
    half_px = np.convolve(np.pad(half, 3, mode="edge"), np.ones(7) / 7, "valid")
    bow = np.polynomial.Polynomial.fit(at, centres, 2)
    inner = np.linspace(at[0] + half_px[0], at[-1] - half_px[-1], BALLS)
    spots = middle + inner[:, None] * along + bow(inner)[:, None] * [-along[1], along[0]]
    x, y = camera.rays(spots[:, 0], spots[:, 1])
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    level = ground.normal if ground.normal @ ground.point_m < 0 else -ground.normal
    radius = np.zeros(BALLS)
    for _ in range(4):
        # The centre lies one radius over the ground.
        z = (level @ ground.point_m + radius) / (rays @ level)
        radius = np.interp(inner, at, half_px) * z / camera.fx_px
    return Tube(rays * z[:, None], radius, level)


def pair_of(capture: Capture, seed: int) -> Pair:
    """Draw the twin of a frame and read it."""
    mask = capture.masks[0]
    ground = fit_ground(capture, mask)
    scene = Scene((body_on(ground, mask, capture.intrinsics),), planes=(ground,))
    camera = D4xx.like(capture.intrinsics)
    seen = render(scene, capture.intrinsics).mask(0)
    reading = sense(scene, camera, np.random.default_rng(seed), frames=1)[0]
    level = cast_plane(ground, capture.intrinsics).depth_m
    return Pair((capture.depth_m, level, mask), (reading, level, seen))


def wall_residual(color: Intrinsics, distance_m: float, window_px: int) -> float:
    """Return the simulated camera's plane residual on a wall at a distance, metres."""
    frames = []
    for seed in range(WALLS):
        wall = Scene((), planes=(Plane.facing(distance_m, tilt_deg=5.0, turn_deg=5.0),))
        rng = np.random.default_rng(1000 + seed)
        reading = sense(wall, D4xx.like(color), rng, frames=1)[0]
        frames.append(plane_residuals(reading, window_px))
    return residual_at(frames, distance_m)[0]


def row(name: str, real: float, twin: float, form: str = "8.2f") -> None:
    """Print one line of the table."""
    print(f"{name:<46}{real:{form}}{twin:{form}}{twin - real:+{form}}")


def mean_profile(profiles: list[EdgeProfile]) -> EdgeProfile:
    """Return the median profile of several frames."""
    heights = np.array([p.height for p in profiles])
    invalid = np.array([p.invalid for p in profiles])
    # An offset at which no frame has a reading stays empty, without a warning.
    some = ~np.isnan(heights).all(axis=0), ~np.isnan(invalid).all(axis=0)
    height, empty = np.full(heights.shape[1], np.nan), np.full(heights.shape[1], np.nan)
    height[some[0]] = np.nanmedian(heights[:, some[0]], axis=0)
    empty[some[1]] = np.nanmean(invalid[:, some[1]], axis=0)
    return EdgeProfile(profiles[0].offset_px, height, empty)


def print_residuals(captures: list[Capture], pairs: list[Pair]) -> None:
    """Print noise: on plain ground, and on the body."""
    cases = [(distance, WINDOW_PX) for distance in DISTANCES_M]
    cases += [(DISTANCES_M[1], window) for window in OTHER_WINDOWS_PX]
    for distance, window in cases:
        real = [plane_residuals(c.depth_m, window) for c in captures]
        measured, count = residual_at(real, distance)
        row(
            f"plane residual, {distance:.2f} m, {window} px, mm ({count})",
            1e3 * measured,
            1e3 * wall_residual(captures[0].intrinsics, distance, window),
        )
    on_body = np.array(
        [[surface_residual(p.real[0], p.real[2]), surface_residual(p.twin[0], p.twin[2])]
         for p in pairs]
    )  # fmt: skip
    row("residual to a quadratic on the body, mm", *(1e3 * np.nanmedian(on_body, axis=0)))


def print_edges(pairs: list[Pair]) -> None:
    """Print how depth falls over the upper outline, where no shadow widens the real masks."""
    real, twin = (
        mean_profile([edge_profile(*part) for part in parts])
        for parts in ([p.real for p in pairs], [p.twin for p in pairs])
    )
    for share in (0.75, 0.5, 0.25):
        name = f"offset where height falls to {share:.0%}, px"
        row(name, real.crossing_px(share), twin.crossing_px(share))
    sideways = []
    for parts in ([p.real for p in pairs], [p.twin for p in pairs]):
        left, right = (
            mean_profile([edge_profile(*part, (way, 0.0)) for part in parts]).crossing_px(0.5)
            for way in (-1.0, 1.0)
        )
        sideways.append((right - left) / 2)
    row("depth stands off colour sideways, px", sideways[0], sideways[1])
    for low, high in ((-14, -6), (-6, 0), (0, 6), (6, 14)):
        part = (real.offset_px >= low) & (real.offset_px < high)
        name = f"without a reading, {low} to {high} px off it, %"
        row(name, 100 * real.invalid[part].mean(), 100 * twin.invalid[part].mean())


def jumps_per_mille(depth_m: NDArray[np.float32], focal_baseline: float) -> float:
    """Return the share of neighbours in a row that both read and differ by over 2 px disparity."""
    read = valid_depth(depth_m)
    disparity = focal_baseline / np.where(read, depth_m, np.inf)
    both = read[:, 1:] & read[:, :-1]
    return float(1e3 * (both & (np.abs(np.diff(disparity, axis=1)) > 2)).mean())


def print_foliage(path: Path) -> None:
    """Print how full a canopy's depth picture is, and how often it jumps without a gap."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint16:
        raise SystemExit(f"{path}: no 16-bit depth picture")
    real = picture.astype(np.float32) / np.float32(1000)
    camera = D4xx.like(Intrinsics(1280, 720, 924.0, 924.0, 640.0, 360.0))
    drawn = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        fruit = tuple(
            place_hanging(random_fruit(rng, 0.25), (x, 0.0, 0.55), spin_deg=rng.uniform(0, 360))
            for x in (-0.15, 0.15)
        )
        scene = trellis(rng, camera.color, fruit)
        drawn.append(sense(scene, camera, rng, frames=1)[0])
    full = [float(100 * (depth > 0).mean()) for depth in (real, np.array(drawn))]
    row("fill of a canopy, %", full[0], full[1])
    row(
        "jumps over 2 px without a gap, per mille",
        jumps_per_mille(real, 32.0),
        float(np.mean([jumps_per_mille(d, 32.0) for d in drawn])),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="a BOP scene with masks of a body on the ground")
    parser.add_argument("--foliage", type=Path, help="16-bit depth picture of a canopy, mm")
    given = parser.parse_args()
    captures = [ref.load() for ref in open_source(given.folder)]
    pairs = [pair_of(capture, seed) for seed, capture in enumerate(captures)]
    print(f"{'':<46}{'real':>8}{'twin':>8}{'differs':>8}")
    print_residuals(captures, pairs)
    fills = np.array([[100 * fill_inside(p.real[0], p.real[2]),
                       100 * fill_inside(p.twin[0], p.twin[2])] for p in pairs])  # fmt: skip
    for capture, (real, twin) in zip(captures, fills, strict=True):
        row(f"fill on the body, {capture.name}, %", real, twin)
    row("fill on the body, mean, %", *fills.mean(axis=0))
    print_edges(pairs)
    if given.foliage:
        print_foliage(given.foliage)
    wall = Scene((), planes=(Plane.facing(0.5),))
    burst = sense(wall, D4xx.like(captures[0].intrinsics), np.random.default_rng(1), frames=5)
    print(f"{'share of the variance fixed in space':<46}{'-':>8}{noise_split(burst):8.2f}")


if __name__ == "__main__":
    main()
