"""Lengths of one mask beside a plain NumPy script and other programs, and the limits of CI."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from cucumbervision.capture.frames import median_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.result import MethodName
from cucumbervision.methods.table import Region, run_methods
from cucumbervision.run.batch import in_process
from cucumbervision.tube.compiled import kernel_name
from cucumbervision_lab.evaluate.measure_case import Baseline, available_baselines
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Scene, render
from speeds.timing import GIVEN, Figure, pace

CAMERA = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
PAPER_METHODS = (MethodName.M1, MethodName.M2, MethodName.M3, MethodName.M4, MethodName.M5)
BINS, SAMPLES = 25, 1000
TRIES = 4
LIMITS = {
    "M1 to M5, times the plain NumPy floor": 4.0,
    "M6, times the plain NumPy floor": 15.0 if kernel_name() == "numpy" else 9.0,
    "a capture with given masks, times its reading alone": 4.0,
    "cucumbervision --help, times Typer and NumPy alone": 3.5,
}


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


def in_turns(others: dict[str, Baseline], rounds: int) -> dict[str, list[float]]:
    """Return the milliseconds of the floor, of M1 to M5, of M6 and of others, taken in turns."""
    drawn = draw_region()
    mask = drawn.mask
    assert mask is not None
    tasks: dict[str, Callable[[], object]] = {
        "floor": lambda: floor(drawn.depth_m, mask, drawn.box),
        "M1 to M5": lambda: run_methods(fresh(drawn), PAPER_METHODS),
        "M6": lambda: run_methods(fresh(drawn), [MethodName.M6]),
        **{name: partial(task, drawn.depth_m, mask, CAMERA) for name, task in others.items()},
    }
    turns = [{name: milliseconds(task) for name, task in tasks.items()} for _ in range(rounds + 5)]
    return {name: [turn[name] for turn in turns[5:]] for name in tasks}


def times_the_floor(taken_ms: dict[str, list[float]], name: str) -> float:
    """Return the median ratio of the pairs."""
    return median(x / f for x, f in zip(taken_ms[name], taken_ms["floor"], strict=True))


def kernels(quick: bool) -> list[Figure]:
    """Compare processor times on a mask of 30,000 pixels with plain NumPy's."""
    programs = available_baselines()
    if "skan" not in programs:
        print("skan is not installed")
    others = {f"{name} {version(name)}": task for name, task in programs.items()}
    taken_ms = in_turns(others, 10 if quick else 60)
    aims = {"M1 to M5": "<= 4"}
    return [
        Figure("plain NumPy floor (deproject, axis, spline)", median(taken_ms["floor"]), "ms"),
        *(
            Figure(
                f"{f'{name}, {kernel_name()}' if name == 'M6' else name}, times the floor",
                times_the_floor(taken_ms, name),
                "x",
                aims.get(name, ""),
            )
            for name in taken_ms
            if name != "floor"
        ),
    ]


def help_times_its_libraries() -> float:
    """Compare the console script's help with a start that loads what it cannot do without."""

    def seconds(code: str) -> float:
        start = os.times()
        subprocess.run([sys.executable, "-c", code, "--help"], check=True, capture_output=True)
        end = os.times()
        return end.children_user + end.children_system - start.children_user - start.children_system

    program, libraries = "from cucumbervision.cli.app import main; main()", "import typer, numpy"
    turns = [(seconds(program), seconds(libraries)) for _ in range(TRIES)]
    return min(own for own, _ in turns) / min(alone for _, alone in turns)


def times_its_reading() -> float:
    """Compare a capture's way through the pipeline with reading it: what is added to every one."""
    captures = list(open_source(example_captures()))

    def read() -> None:
        for ref in captures:
            ref.load()

    read()
    reading_s = 1e-3 * milliseconds(read) / len(captures)
    return pace(GIVEN, in_process, 9, 3, time.process_time) / reading_s


def check() -> int:
    """Print each quick ratio beside its limit: what CI runs. The best of a few tries counts."""
    turns = [in_turns({}, 20) for _ in range(TRIES)]
    ratios = (
        *(min(times_the_floor(turn, name) for turn in turns) for name in ("M1 to M5", "M6")),
        min(times_its_reading() for _ in range(TRIES)),
        help_times_its_libraries(),
    )
    for (name, limit), ratio in zip(LIMITS.items(), ratios, strict=True):
        print(f"{name}: {ratio:.2f} (limit {limit:.2f}) {'ok' if ratio <= limit else 'TOO SLOW'}")
    return int(any(ratio > limit for ratio, limit in zip(ratios, LIMITS.values(), strict=True)))
