"""Side questions that the benchmark answers: wrong intrinsics, burst size, prompts, conventions."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.statistics import score
from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.capture.source import ReadOptions
from cucumbervision.geometry.camera import scale_error_tilted
from cucumbervision.geometry.curve import polyline_length
from cucumbervision.measurement.m6 import measure_m6
from cucumbervision_lab.benchmark.cases import CAMERA, Suite
from cucumbervision_lab.report.records import Masks
from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
from cucumbervision_lab.synthesis.scene import Scene, render

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import pandas as pd

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision_lab.synthesis.bodies import Tube

# Focal lengths in pixels at 1280x720 that are mistaken for the colour stream's in practice.
_WRONG_FOCALS_PX = {
    "depth stream of a D435 (640)": 640.0,
    "depth stream of a D415 (895)": 895.0,
    "colour stream at 640x480 (617)": 617.0,
    "colour stream at 1920x1080 (1365)": 1365.0,
}
_TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
_SIZES_M = ((0.0, 0.10), (0.10, 0.18), (0.18, 0.45))


def wrong_intrinsics() -> Table:
    """Measure one exact fruit with wrong focal lengths at several tilts, against the formula.

    Notes
    -----
    With k = f_right / f_wrong, a length at tilt t reads L' / L = sqrt(k² cos² t + sin² t).
    """
    rows = []
    for name, focal in _WRONG_FOCALS_PX.items():
        for tilt in _TILTS_DEG:
            tube = arc_tube(0.20, 0.015).moved(rotation(90, tilt), (0, 0, 0.6))
            scene = render(Scene.of(tube), CAMERA)
            wrong = replace(CAMERA, fx_px=focal, fy_px=focal)
            found = measure_m6(scene.depth_m.astype(np.float32), scene.mask(0), wrong)
            formula = 100 * scale_error_tilted(CAMERA.fx_px, focal, tilt)
            read = np.nan if found.length_m is None else 100 * (found.length_m / 0.20 - 1)
            rows.append((name, tilt, round(formula, 1), _line_error(tube, wrong), round(read, 1)))
    return Table.of(
        "Wrong intrinsics",
        ("taken for the colour stream's", "tilt [deg]", "formula [%]", "axis [%]", "M6 [%]"),
        tuple(rows),
        "A straight fruit of 20 cm, exact depth, deprojected with another stream's or another "
        "size's focal length. The sign and the size follow from the two focal lengths, so no "
        "constant can correct it; the reader refuses such intrinsics. The formula is a thin "
        "line's; M6 errs more, because the fruit grows thicker too, before the same depth.",
    )


def _line_error(tube: Tube, wrong: Intrinsics) -> float:
    """Compute the error of the axis itself, deprojected by the wrong camera."""
    axis = tube.axis_m
    u, v = CAMERA.project(axis).T
    x, y = wrong.rays(u, v)
    lifted = np.stack([x, y, np.ones_like(x)], axis=1) * axis[:, 2:]
    return round(100 * (polyline_length(lifted) / polyline_length(axis) - 1), 1)


def carrot_intrinsics(folder: Path) -> Table:
    """Measure the real carrot frames with a depth stream's focal length instead of their own."""
    from cucumbervision.capture.readers import open_source
    from cucumbervision.measurement.cloud import masked_points
    from cucumbervision.measurement.m2_m3 import measure_m3

    errors = []
    for ref in open_source(folder, ReadOptions()):
        capture = ref.load()
        own = capture.intrinsics
        wrong = replace(own, fx_px=640.0, fy_px=640.0, cx_px=own.cx_px, cy_px=own.cy_px)
        right, scaled = (
            measure_m3(masked_points(capture.depth_m, capture.masks[0], camera)).length_m
            for camera in (own, wrong)
        )
        if right and scaled:
            errors.append(100 * (scaled / right - 1))
    formula = 100 * (own.fx_px / 640.0 - 1)
    row = (len(errors), round(float(np.mean(errors)), 1), round(float(np.std(errors)), 2))
    return Table.of(
        "Wrong intrinsics on real frames",
        ("frames", "error, mean [%]", "sd [%]", "formula for no tilt [%]"),
        ((*row, round(formula, 1)),),
        "Ten RealSense frames of one carrot lying across the view, by M3, with f = 640 px in "
        "place of the colour stream's.",
    )


def burst_sizes(
    measure: Callable[[int], pd.DataFrame], sizes: Sequence[int] = (1, 3, 5, 9)
) -> Table:
    """Compare bursts; `measure` gives the readings of the same cases for a burst size."""
    rows: list[tuple[Cell, ...]] = []
    for size in sizes:
        readings = measure(size)
        rows.append(
            (
                size,
                readings["case"].nunique(),
                *(_mape(readings, name) for name in ("M3", "M5", "M6")),
            )
        )
    return Table.of(
        "Burst size",
        ("frames", "captures", "M3 MAPE [%]", "M5 MAPE [%]", "M6 MAPE [%]"),
        tuple(rows),
        "The same captures with exact masks. Most of the sensor's noise is fixed in space, so "
        "more frames help little beyond filling holes.",
    )


def sam_prompts(measure: Callable[[str], pd.DataFrame]) -> Table:
    """Compare SAM's prompts; `measure` gives readings on perceived masks for a prompt."""
    rows: list[tuple[Cell, ...]] = []
    for prompt in ("box+point", "box", "point"):
        readings = measure(prompt)
        captures = readings.drop_duplicates("case")
        failed = int((captures["mask_failure"] != "").sum())
        overlap = round(float(captures["mask_iou"].mean()), 3)
        rows.append((prompt, len(captures), failed, overlap, _mape(readings, "M6")))
    return Table.of(
        "SAM's prompt",
        ("prompt", "captures", "masks refused", "mask IoU, mean", "M6 MAPE [%]"),
        tuple(rows),
        "MobileSAM, prompted by the detector's boxes; a fruit that is not found counts as refused.",
    )


def selectors(readings: pd.DataFrame) -> Table:
    """Compare the selectors on the paper's captures, by kind of mask."""
    rows: list[tuple[Cell, ...]] = []
    for masks in Masks:
        some = readings[(readings["masks"] == masks) & (readings["suite"] != Suite.STRESS)]
        if len(some):
            count = len(some[["suite", "case"]].drop_duplicates())
            for name in ("selector paper", "selector best"):
                rows.append((name.split()[1], str(masks), count, _mape(some, name)))
    return Table.of(
        "Selector",
        ("selector", "masks", "captures", "MAPE [%]"),
        tuple(rows),
        "Raw length of the chosen method against the centreline.",
    )


def length_conventions(readings: pd.DataFrame) -> Table:
    """Compare thread and chord with the centreline from the centreline, by size."""
    rows: list[tuple[Cell, ...]] = []
    known = readings.dropna(subset=["thread_m", "centreline_m", "chord_m"])
    fruit = known.drop_duplicates("fruit", keep="last")
    for low, high in _SIZES_M:
        some = fruit[fruit["centreline_m"].between(low, high, inclusive="left")]
        if len(some):
            more = 100 * (some[["thread_m", "chord_m"]].div(some["centreline_m"], axis=0) - 1)
            means = [round(float(x), 1) for x in more.mean()]
            rows.append((f"{100 * low:.0f} to {100 * high:.0f} cm", len(some), *means))
    return Table.of(
        "Thread, centreline, chord",
        ("centreline", "fruit", "thread, mean [%]", "chord, mean [%]"),
        tuple(rows),
        "What people lay along a fruit differs by more than any good method errs: say which.",
    )


def _mape(readings: pd.DataFrame, method: str) -> float:
    read = readings[readings["method"] == method]
    return round(score(read["length_m"], read["centreline_m"]).mape_percent, 2)
