"""Real cucumbers before a real D435: every method against lengths read off a ruler and a grid.

    python benchmarks/real_cucumbers.py FOLDER [--segmenter none] [--input-size 640]
        [--calibration FILE]

FOLDER holds `beside_ruler/`, `on_grid/` and `intrinsics.json`. 26 colour pictures show 28 marked
fruit; `real_cucumbers.json` holds what was marked in them, twice, without depth and before anything
was measured: both ends (the body without stem or flower) and edge to edge across the axis, and the
crossings of printed lines of 1 cm (a ruler's of 5 mm) as found to a fraction of a pixel around
places counted by hand. On the mat the edges were moved to the step of colour, and the second pass
took other places along the fruit; both ends were marked anew in pictures turned upside down.
`marked_lengths.py` turns that into lengths. The lens' distortion comes from the mat's lines; on the
ruler, another day, it halves what remains of its lines (0.13 to 0.07 px).

The plane is the mat's, or the table's, which slid under a camera that stood still: one plane for
four places of the ruler, 37.9 cm away, tilted by 1.6 degrees to a side and by 0.0 ± 0.3 to the
other. Its print is taken to be 1 ± 1 mm above the table. A fifth fruit of the last picture is not
marked: it lies across the table's edge, one side in black shadow.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from marked_lengths import (
    MarkedLengths,
    Marks,
    PlaneCamera,
    camera_over,
    level_hits,
    marked_lengths,
)
from rich.console import Console
from rich.table import Table

from cucumbervision.capture.source import ReadOptions
from cucumbervision.measurement.flags import Flag
from cucumbervision.measurement.methods import AVAILABLE
from cucumbervision.measurement.result import MethodName
from cucumbervision.perception.input_sizes import parse_input_sizes
from cucumbervision.pipeline.inputs import read_captures
from cucumbervision.pipeline.measurer import Failure, Measurer
from cucumbervision.pipeline.options import MeasureOptions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision.measurement.result import FruitMeasurement

MARKED = Path(__file__).with_suffix(".json")
PLACES = ("beside_ruler", "on_grid")
HEIGHT_ERROR = 0.07  # of the radius: how well the axis' height over the plane is known
PLANE_ERROR_PERCENT = {"beside_ruler": 0.35, "on_grid": 0.25}
END_FLAGS = (Flag.END_HIDDEN, Flag.ENDS_UNSURE, Flag.ENDS_DISAGREE)


@dataclass(frozen=True, eq=False)
class Truth:
    """One marked fruit: its lengths by both passes, and their mean's standard error in percent."""

    capture: str
    place: str
    middle_px: NDArray[np.float64]
    camera: PlaneCamera
    passes: tuple[MarkedLengths, MarkedLengths]
    error_percent: float

    def cm(self, kind: str) -> float:
        """Return the mean of both passes."""
        return float(np.mean([getattr(one, f"{kind}_cm") for one in self.passes]))

    def apart_percent(self, kind: str) -> float:
        """Return how far the passes are from one another."""
        first, second = (getattr(one, f"{kind}_cm") for one in self.passes)
        return float(200 * abs(second - first) / (first + second))


@dataclass(frozen=True, eq=False)
class Compared:
    """A marked fruit and what was measured of it; None where it was not found."""

    truth: Truth
    fruit: FruitMeasurement | None
    scale: float
    intrinsics: Intrinsics

    def read_cm(self, method: str | None) -> float | None:
        """Return a method's own raw length, or what is reported without one."""
        if self.fruit is None:
            return None
        if method is None:
            return None if self.fruit.length is None else 100 * self.fruit.length.value_m
        one = self.fruit.measurements[method]
        return 100 * one.length_m if one.is_direct and one.length_m is not None else None

    def end_errors_mm(self) -> tuple[float, float] | None:
        """Return how far M6 goes beyond each marked tip as seen, whatever the depth's scale."""
        fit = None if self.fruit is None else self.fruit.measurements[MethodName.M6].fit
        if fit is None:
            return None
        axis, camera = self.truth.passes[0].axis_cm, self.truth.camera
        ends = np.array([fit.traits.axis_m[0], fit.traits.axis_m[-1]])
        pixels = self.intrinsics.project(ends)
        hits = level_hits(camera, camera.rays(pixels), float(axis[0, 2]))
        tips, inner = axis[[0, -1]], axis[[40, -41]]
        if np.linalg.norm(hits[0] - tips[0]) > np.linalg.norm(hits[1] - tips[0]):
            hits = hits[::-1]
        outwards = (tips - inner) / np.linalg.norm(tips - inner, axis=1, keepdims=True)
        first, second = 10 * ((hits - tips) * outwards).sum(1)
        return float(first), float(second)

    def camera_percent(self) -> float:
        """Return the error of depth's scale and of the lens, that the intrinsics leave out."""
        camera, axis = self.truth.camera, self.truth.passes[0].axis_cm
        points = (axis - camera.centre) @ camera.rotation.T
        lens = camera.distortion
        seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, lens)[0]
        flat = self.intrinsics.rays(*np.asarray(seen).reshape(-1, 2).T)
        read = np.column_stack([*flat, np.ones(len(points))]) * points[:, 2:] * self.scale
        lengths = [np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in (read, points)]
        return float(100 * (lengths[0] / lengths[1] - 1))


def read_truth(matrix: NDArray[np.float64], file: Path = MARKED) -> list[Truth]:
    """Return the marked fruit, seen by a camera of that matrix."""
    marked = json.loads(file.read_text())
    lens, fruit = np.array(marked["distortion"]), []
    for one in marked["fruit"]:
        known, place = marked["known"].get(one["capture"]), "on_grid"
        if known is None:
            known, place = marked["ruler"], "beside_ruler"
        camera = camera_over(matrix, lens, np.array(known))
        if place == "beside_ruler":
            camera.centre[2] += marked["ruler_over_table_cm"]
        passes = [
            Marks(np.array(p["tips"]), tuple(one["rounded"]), np.array(p["pairs"]))
            for p in one["passes"]
        ]
        first, second = (marked_lengths(camera, marks) for marks in passes)
        low, high = (
            marked_lengths(camera, passes[0], share).centreline_cm
            for share in (1 + HEIGHT_ERROR, 1 - HEIGHT_ERROR)
        )
        parts = (
            50 * (second.centreline_cm / first.centreline_cm - 1),
            50 * (high / low - 1),
            PLANE_ERROR_PERCENT[place],
        )
        pairs = passes[0].pairs
        middle = pairs[len(pairs) // 2].reshape(2, 2).mean(0)
        error = float(np.linalg.norm(parts))
        fruit.append(Truth(one["capture"], place, middle, camera, (first, second), error))
    return fruit


def depth_scale(capture: Capture, truths: list[Truth], covered: NDArray[np.bool_]) -> float:
    """Return the plane's distance by depth over that by its lines, beside the fruit."""
    camera = truths[0].camera
    around = np.vstack([one.passes[0].axis_cm[:, :2] for one in truths])
    columns, lines = np.meshgrid(np.arange(4, 1280, 8), np.arange(4, 720, 8))
    pixels = np.c_[columns.ravel(), lines.ravel()].astype(float)
    rays = camera.rays(pixels)
    far = camera.centre[2] / -np.minimum(rays[:, 2], -0.05)
    spots = (camera.centre + far[:, None] * rays)[:, :2]
    beside = ((spots > around.min(0) - 3) & (spots < around.max(0) + 3)).all(1)
    at = pixels.astype(int)
    read = capture.depth_m[at[:, 1], at[:, 0]]
    free = beside & (read > 0) & ~covered[at[:, 1], at[:, 0]]
    expected = far * (rays @ camera.rotation.T)[:, 2] / 100
    ratio = read[free] / expected[free]
    return float(np.median(ratio[np.abs(ratio - 1) < 0.06]))


def compare(folder: Path, options: MeasureOptions) -> tuple[list[Compared], int]:
    """Measure all captures; return the marked fruit, and how many others were found."""
    camera = json.loads((folder / "intrinsics.json").read_text())
    matrix = np.array(
        [[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]]
    )
    truths, compared, others = read_truth(matrix), [], 0
    measurer = Measurer(options)
    reading = ReadOptions(intrinsics=folder / "intrinsics.json")
    for capture in read_captures([folder / place for place in PLACES], reading):
        if isinstance(capture, Failure):
            raise SystemExit(capture.message)
        result = measurer.measure(capture)
        here = [one for one in truths if capture.name.startswith(one.capture)]
        covered = np.zeros(capture.depth_m.shape, bool)
        for fruit in result.fruit:
            left, top, right, bottom = np.rint(fruit.instance.box).astype(int)
            covered[max(top - 12, 0) : bottom + 12, max(left - 12, 0) : right + 12] |= (
                True
                if fruit.mask is None
                else widened(fruit.mask)[
                    max(top - 12, 0) : bottom + 12, max(left - 12, 0) : right + 12
                ]
            )
        scale, free = depth_scale(result.capture, here, covered), list(result.fruit)
        for truth in here:
            column, line = np.rint(truth.middle_px).astype(int)
            hit = [f for f in free if f.mask is not None and f.mask[line, column]]
            found = hit[0] if hit else None
            compared.append(Compared(truth, found, scale, result.capture.intrinsics))
            free = [f for f in free if f not in hit[:1]]
        others += len(free)
    return compared, others


def widened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask with 12 pixels around it."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0)


def methods_table(compared: list[Compared]) -> Table:
    """Return each method's errors against the truth of a kind."""
    table = Table(title="Length against what was marked")
    for head in ("method", "against", "found", "median |error| %", "bias %", "worst %"):
        table.add_column(head, justify="right")
    for method in (*AVAILABLE, None):
        for kind in (
            ("centreline",) if method in (MethodName.M6, None) else ("centreline", "thread")
        ):
            pairs = [(c.read_cm(method), c.truth.cm(kind)) for c in compared]
            errors = np.array([100 * (read / true - 1) for read, true in pairs if read is not None])
            table.add_row(
                "reported" if method is None else str(method),
                kind,
                f"{len(errors)} of {len(pairs)}",
                *(
                    (
                        f"{np.median(np.abs(errors)):.1f}",
                        f"{errors.mean():+.1f}",
                        f"{errors[np.abs(errors).argmax()]:+.1f}",
                    )
                    if len(errors)
                    else ("–",) * 3
                ),
            )
    return table


def fruit_table(compared: list[Compared]) -> Table:
    """Return one line a fruit."""
    table = Table(title="Every fruit: centreline, cm; M6's ends against the marked ones, mm")
    heads = "capture|true|± %|passes %|reported|error %|camera's %|interval|ends mm|flags"
    for head in heads.split("|"):
        table.add_column(head, justify="right")
    for one in compared:
        true, read, ends = one.truth.cm("centreline"), one.read_cm(None), one.end_errors_mm()
        length = None if one.fruit is None else one.fruit.length
        interval = "–"
        if length is not None and length.low_m is not None and length.high_m is not None:
            interval = f"{100 * length.low_m:.1f}–{100 * length.high_m:.1f}"
        table.add_row(
            one.truth.capture,
            f"{true:.2f}",
            f"{one.truth.error_percent:.1f}",
            f"{one.truth.apart_percent('centreline'):.1f}",
            "–" if read is None else f"{read:.2f}",
            "–" if read is None else f"{100 * (read / true - 1):+.1f}",
            f"{one.camera_percent():+.1f}",
            interval,
            "–" if ends is None else f"{ends[0]:+.1f} {ends[1]:+.1f}",
            "not found" if one.fruit is None else " ".join(one.fruit.flags),
        )
    return table


def narrowest(compared: list[Compared]) -> str:
    """Return how narrow one interval for all could be, chosen in hindsight."""
    errors = np.array(
        [np.log(r / c.truth.cm("centreline")) for c in compared if (r := c.read_cm(None))]
    )
    cameras = np.log1p([c.camera_percent() / 100 for c in compared if c.read_cm(None)])
    said = []
    for some in (errors, errors - cameras):
        held, ordered = int(np.ceil(0.9 * len(some))), np.sort(some)
        span = (ordered[held - 1 :] - ordered[: len(ordered) - held + 1]).min()
        said.append(f"{100 * span:.1f} %")
    return (
        f"in hindsight the narrowest interval that holds 90 %: {said[0]} wide; without the "
        f"camera's own error {said[1]}"
    )


def summary(compared: list[Compared], others: int) -> list[str]:
    """Return what the tables do not say."""
    lines = []
    for kind in ("chord", "centreline"):
        apart = [one.truth.apart_percent(kind) for one in compared]
        median, most = np.median(apart), np.percentile(apart, 90)
        lines.append(f"{kind}, marked twice: median {median:.2f} % apart, 90 % within {most:.2f} %")
    held, widths = [], []
    flags: Counter[Flag] = Counter()
    for one in compared:
        if one.fruit is None:
            continue
        flags.update(flag for flag in END_FLAGS if flag in one.fruit.flags)
        length, true = one.fruit.length, one.truth.cm("centreline") / 100
        if length is not None and length.low_m is not None and length.high_m is not None:
            held.append(length.low_m <= true <= length.high_m)
            widths.append(100 * (length.high_m - length.low_m) / length.value_m)
    cover, width, middle = 100 * np.mean(held), np.mean(widths), np.median(widths)
    width_said = f"width {width:.1f} % (mean), {middle:.1f} % (median)"
    lines.append(f"{len(held)} intervals: cover {cover:.0f} %, {width_said}")
    lines.append(narrowest(compared))
    said = ", ".join(f"{flag} {flags[flag]}" for flag in END_FLAGS)
    lines.append(f"both ends are in sight, and yet flagged: {said} of {len(compared)}")
    for place in PLACES:
        scales = 100 * (np.array([c.scale for c in compared if c.truth.place == place]) - 1)
        lines.append(
            f"{place}: the plane by depth is {np.median(scales):+.2f} % further than by its lines "
            f"({scales.min():+.2f} to {scales.max():+.2f})"
        )
    reads = [(c.read_cm(None), c) for c in compared]
    errors = [100 * (read / c.truth.cm("centreline") - 1) for read, c in reads if read]
    cameras = [c.camera_percent() for read, c in reads if read]
    own = np.subtract(errors, cameras)
    lines.append(
        f"depth's scale and the lens alone: {np.mean(cameras):+.2f} %; without them what is "
        f"reported errs by {np.median(np.abs(own)):.2f} % (median), bias {np.mean(own):+.2f} "
        f"(median {np.median(own):+.2f}) %"
    )
    sources = Counter(str(c.fruit.mask_source) for c in compared if c.fruit is not None)
    lines.append("masks by " + ", ".join(f"{name}: {n}" for name, n in sources.most_common()))
    lines.append(f"{others} other fruit found")
    return lines


def main() -> None:
    """Measure, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--segmenter", help="as `measure --segmenter`")
    parser.add_argument("--calibration", type=Path, help="as `measure --calibration`")
    parser.add_argument("--input-size", default="", help="as `measure --input-size`")
    given = parser.parse_args()
    options = MeasureOptions(
        segmenter=given.segmenter,
        calibration=given.calibration,
        input_sizes=parse_input_sizes(given.input_size),
    )
    compared, others = compare(given.folder, options)
    console = Console(width=170, highlight=False)
    console.print(fruit_table(compared))
    console.print(methods_table(compared))
    for line in summary(compared, others):
        console.print(line, soft_wrap=True)


if __name__ == "__main__":
    main()
