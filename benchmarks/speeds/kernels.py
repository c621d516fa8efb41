"""Lengths of one mask beside a plain NumPy script."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
from figures import Figure
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from cucumbervision.capture.frames import median_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.result import MethodName
from cucumbervision.methods.table import Region, run_methods
from cucumbervision.tube.compiled import kernel_name
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Scene, render

CAMERA = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)


PAPER_METHODS = (MethodName.M1, MethodName.M2, MethodName.M3, MethodName.M4, MethodName.M5)


BINS, SAMPLES = 25, 1000


def draw_region() -> Region:
    """Draw a fruit whose mask has about 30,000 pixels, with its keypoints."""
    tube = arc_tube(0.25, 0.0205, 0.5, neck=0.2).moved(rotation(8, 10), (0.0, 0.0, 0.52))
    scene = Scene.of(tube, backdrop_m=0.9)
    depth = median_depth(sense(scene, D4xx.like(CAMERA), np.random.default_rng(1)))
    axis = tube.axis_m[np.linspace(12, len(tube.axis_m) - 13, 5).astype(int)]
    pixels = axis[:, :2] / axis[:, 2:] * CAMERA.fx_px + (CAMERA.cx_px, CAMERA.cy_px)
    keypoints = np.column_stack([pixels, np.ones(5)])
    mask = render(scene, CAMERA).mask(0)
    return Region(depth, CAMERA, box_of_mask(mask), mask, keypoints)


def floor(depth_m: NDArray[np.float32], mask: NDArray[np.bool_], box: NDArray[Any]) -> float:
    """Measure along 25 centroids in plain NumPy, without a gate, anchors or checks."""
    left, top, right, bottom = (int(x + 0.5) for x in box)
    part = depth_m[top:bottom, left:right]
    v, u = np.nonzero(mask[top:bottom, left:right] & (part > 0))
    z = part[v, u].astype(np.float64)
    x = (u + (left - CAMERA.cx_px)) / CAMERA.fx_px * z
    y = (v + (top - CAMERA.cy_px)) / CAMERA.fy_px * z
    points = np.stack([x, y, z], axis=1)
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1]
    low, high = along.min(), along.max()
    which = np.minimum(((along - low) * (BINS / (high - low))).astype(np.intp), BINS - 1)
    count = np.bincount(which, minlength=BINS)
    held = np.flatnonzero(count)  # a stray reading far off stretches the axis, and leaves gaps
    sums = np.stack([np.bincount(which, points[:, k], BINS) for k in range(3)], axis=1)
    spine = sums[held] / count[held, None]
    parameter = held / (BINS - 1)
    speed = CubicSpline(parameter, spine, bc_type="natural")(np.linspace(0, 1, SAMPLES), 1)
    return float(np.trapezoid(np.linalg.norm(speed, axis=1), dx=1 / (SAMPLES - 1)))


def milliseconds(task: Callable[[], object]) -> float:
    """Return one call's processor time, which what else runs touches less than the clock's."""
    start = time.process_time()
    task()
    return 1e3 * (time.process_time() - start)


def fresh(drawn: Region) -> Region:
    """Return the region without its clouds, which each timing must build anew."""
    return Region(drawn.depth_m, CAMERA, drawn.box, drawn.mask, drawn.keypoints)


def timed(drawn: Region, rounds: int) -> tuple[list[float], list[float], list[float]]:
    """Return the milliseconds of the floor, of M1 to M5 and of M6, taken in turns."""
    mask = drawn.mask
    assert mask is not None
    floors, papers, tubes = [], [], []
    for _ in range(rounds + 5):
        floors.append(milliseconds(lambda: floor(drawn.depth_m, mask, drawn.box)))
        papers.append(milliseconds(lambda: run_methods(fresh(drawn), PAPER_METHODS)))
        tubes.append(milliseconds(lambda: run_methods(fresh(drawn), [MethodName.M6])))
    return floors[5:], papers[5:], tubes[5:]


def times_the_floor(floors: list[float], papers: list[float]) -> float:
    """Return the median ratio of the pairs."""
    return median(p / f for p, f in zip(papers, floors, strict=True))


def kernels(quick: bool) -> list[Figure]:
    """Compare M1 to M5 with plain NumPy on a mask of 30,000 pixels."""
    floors, papers, tubes = timed(draw_region(), 10 if quick else 60)
    ratio = times_the_floor(floors, papers)
    return [
        Figure("plain NumPy floor (deproject, axis, spline)", median(floors), "ms"),
        Figure("M1 to M5 together, times the floor", ratio, "x", "<= 4"),
        Figure(f"M6 a fruit, kernel {kernel_name()}", median(tubes), "ms"),
        Figure("the same, times the floor", times_the_floor(floors, tubes), "x"),
    ]
