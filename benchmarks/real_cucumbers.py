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
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import MethodName
from cucumbervision.methods.table import AVAILABLE
from cucumbervision.networks.yolo import parse_input_sizes
from cucumbervision.run.batch import read_captures
from cucumbervision.run.measurer import Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.tube.shape import polyline_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision.methods.result import Fruit

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
        return float(np.mean([getattr(lengths, f"{kind}_cm") for lengths in self.passes]))

    def apart_percent(self, kind: str) -> float:
        """Return how far the passes are from one another."""
        first, second = (getattr(lengths, f"{kind}_cm") for lengths in self.passes)
        return float(200 * abs(second - first) / (first + second))


@dataclass(frozen=True, eq=False)
class Comparison:
    """A marked fruit and what was measured of it; None where it was not found."""

    truth: Truth
    fruit: Fruit | None
    scale: float
    intrinsics: Intrinsics

    def read_cm(self, method: str | None) -> float | None:
        """Return a method's own raw length, or what is reported without one."""
        if self.fruit is None:
            return None
        if method is None:
            return None if self.fruit.length is None else 100 * self.fruit.length.value_m
        measurement = self.fruit.measurements[method]
        if not measurement.is_direct or measurement.length_m is None:
            return None
        return 100 * measurement.length_m

    def level_axis_cm(self) -> NDArray[np.float64] | None:
        """Return M6's axis as seen, put where the truth's is: one radius above the plane."""
        fit = None if self.fruit is None else self.fruit.measurements[MethodName.M6].fit
        if fit is None:
            return None
        camera, level_cm = self.truth.camera, float(self.truth.passes[0].axis_cm[0, 2])
        return level_hits(camera, camera.rays(self.intrinsics.project(fit.traits.axis_m)), level_cm)

    def picture_percent(self) -> float | None:
        """Return the error of M6's axis as seen, whatever its depth."""
        axis_cm = self.level_axis_cm()
        if axis_cm is None:
            return None
        return 100 * (polyline_length(axis_cm) / polyline_length(self.truth.passes[0].axis_cm) - 1)

    def end_errors_mm(self) -> tuple[float, float] | None:
        """Return how far M6 goes beyond each marked tip as seen, whatever the depth's scale."""
        axis_cm = self.level_axis_cm()
        if axis_cm is None:
            return None
        axis, hits = self.truth.passes[0].axis_cm, axis_cm[[0, -1]]
        tips, inner = axis[[0, -1]], axis[[40, -41]]
        if np.linalg.norm(hits[0] - tips[0]) > np.linalg.norm(hits[1] - tips[0]):
            hits = hits[::-1]
        outwards = (tips - inner) / np.linalg.norm(tips - inner, axis=1, keepdims=True)
        first, second = 10 * ((hits - tips) * outwards).sum(1)
        return float(first), float(second)

    def pixel_mm(self) -> float:
        """Return what a pixel spans at the fruit."""
        far_cm = np.linalg.norm(self.truth.camera.centre - self.truth.passes[0].axis_cm.mean(0))
        return float(10 * far_cm / self.intrinsics.fx_px)

    def camera_percent(self) -> float:
        """Return the error of depth's scale and of the lens, that the intrinsics leave out."""
        camera, axis = self.truth.camera, self.truth.passes[0].axis_cm
        points = (axis - camera.centre) @ camera.rotation.T
        lens = camera.distortion
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, lens)[0]
        ray = self.intrinsics.rays(*np.asarray(pixels).reshape(-1, 2).T)
        read_cm = np.column_stack([*ray, np.ones(len(points))]) * points[:, 2:] * self.scale
        return 100 * (polyline_length(read_cm) / polyline_length(points) - 1)


def read_truth(matrix: NDArray[np.float64], file: Path = MARKED) -> list[Truth]:
    """Return the marked fruit, seen by a camera of that matrix."""
    marked = json.loads(file.read_text())
    lens, fruit = np.array(marked["distortion"]), []
    for fruit_marks in marked["fruit"]:
        pose, place = marked["known"].get(fruit_marks["capture"]), "on_grid"
        if pose is None:
            pose, place = marked["ruler"], "beside_ruler"
        camera = camera_over(matrix, lens, np.array(pose))
        if place == "beside_ruler":
            camera.centre[2] += marked["ruler_over_table_cm"]
        passes = [
            Marks(np.array(p["tips"]), tuple(fruit_marks["rounded"]), np.array(p["pairs"]))
            for p in fruit_marks["passes"]
        ]
        first, second = (marked_lengths(camera, marks) for marks in passes)
        shorter, longer = (
            marked_lengths(camera, passes[0], share).centreline_cm
            for share in (1 + HEIGHT_ERROR, 1 - HEIGHT_ERROR)
        )
        error_parts = (
            50 * (second.centreline_cm / first.centreline_cm - 1),
            50 * (longer / shorter - 1),
            PLANE_ERROR_PERCENT[place],
        )
        pairs = passes[0].pairs
        middle = pairs[len(pairs) // 2].reshape(2, 2).mean(0)
        error = float(np.linalg.norm(error_parts))
        fruit.append(Truth(fruit_marks["capture"], place, middle, camera, (first, second), error))
    return fruit


def depth_scale(capture: Capture, truths: list[Truth], covered: NDArray[np.bool_]) -> float:
    """Return the plane's distance by depth over that by its lines, beside the fruit."""
    camera = truths[0].camera
    around = np.vstack([truth.passes[0].axis_cm[:, :2] for truth in truths])
    columns, lines = np.meshgrid(np.arange(4, 1280, 8), np.arange(4, 720, 8))
    pixels = np.c_[columns.ravel(), lines.ravel()].astype(float)
    rays = camera.rays(pixels)
    range_cm = camera.centre[2] / -np.minimum(rays[:, 2], -0.05)
    plane_cm = (camera.centre + range_cm[:, None] * rays)[:, :2]
    is_near = ((plane_cm > around.min(0) - 3) & (plane_cm < around.max(0) + 3)).all(1)
    pixel = pixels.astype(int)
    depth_m = capture.depth_m[pixel[:, 1], pixel[:, 0]]
    free = is_near & (depth_m > 0) & ~covered[pixel[:, 1], pixel[:, 0]]
    expected = range_cm * (rays @ camera.rotation.T)[:, 2] / 100
    ratio = depth_m[free] / expected[free]
    return float(np.median(ratio[np.abs(ratio - 1) < 0.06]))


def compare(folder: Path, options: MeasureOptions) -> tuple[list[Comparison], int]:
    """Measure all captures; return the marked fruit, and how many others were found."""
    camera = json.loads((folder / "intrinsics.json").read_text())
    matrix = np.array(
        [[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]]
    )
    truths, comparisons, further_fruit = read_truth(matrix), [], 0
    measurer = Measurer(options)
    reading = ReadOptions(intrinsics=folder / "intrinsics.json")
    for capture in read_captures([folder / place for place in PLACES], reading):
        if isinstance(capture, Failure):
            raise SystemExit(capture.message)
        result = measurer.measure(capture)
        capture_truths = [truth for truth in truths if capture.name.startswith(truth.capture)]
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
        scale, free = depth_scale(result.capture, capture_truths, covered), list(result.fruit)
        for truth in capture_truths:
            column, line = np.rint(truth.middle_px).astype(int)
            hit = [f for f in free if f.mask is not None and f.mask[line, column]]
            measured = hit[0] if hit else None
            comparisons.append(Comparison(truth, measured, scale, result.capture.intrinsics))
            free = [f for f in free if f not in hit[:1]]
        further_fruit += len(free)
    return comparisons, further_fruit


def widened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask with 12 pixels around it."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0)


def methods_table(comparisons: list[Comparison]) -> Table:
    """Return each method's errors against the truth of a kind."""
    table = Table(title="Length against what was marked")
    for head in ("method", "against", "found", "median |error| %", "bias %", "worst %"):
        table.add_column(head, justify="right")
    for method in (*AVAILABLE, None):
        for kind in (
            ("centreline",) if method in (MethodName.M6, None) else ("centreline", "thread")
        ):
            pairs = [(c.read_cm(method), c.truth.cm(kind)) for c in comparisons]
            errors = np.array(
                [100 * (read_cm / true_cm - 1) for read_cm, true_cm in pairs if read_cm is not None]
            )
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


def fruit_table(comparisons: list[Comparison]) -> Table:
    """Return one line a fruit."""
    table = Table(title="Every fruit: centreline, cm; M6's ends against the marked ones, mm")
    heads = "capture|true|± %|passes %|reported|error %|camera's %|interval|ends mm|flags"
    for head in heads.split("|"):
        table.add_column(head, justify="right")
    for comparison in comparisons:
        true_cm, read_cm = comparison.truth.cm("centreline"), comparison.read_cm(None)
        ends = comparison.end_errors_mm()
        length = None if comparison.fruit is None else comparison.fruit.length
        interval = "–"
        if length is not None and length.low_m is not None and length.high_m is not None:
            interval = f"{100 * length.low_m:.1f}–{100 * length.high_m:.1f}"
        table.add_row(
            comparison.truth.capture,
            f"{true_cm:.2f}",
            f"{comparison.truth.error_percent:.1f}",
            f"{comparison.truth.apart_percent('centreline'):.1f}",
            "–" if read_cm is None else f"{read_cm:.2f}",
            "–" if read_cm is None else f"{100 * (read_cm / true_cm - 1):+.1f}",
            f"{comparison.camera_percent():+.1f}",
            interval,
            "–" if ends is None else f"{ends[0]:+.1f} {ends[1]:+.1f}",
            "not found" if comparison.fruit is None else " ".join(comparison.fruit.flags),
        )
    return table


def ends_and_depth(comparisons: list[Comparison]) -> str:
    """Return how far M6's ends are off as seen, and what its axis errs in the picture alone."""
    ends_mm = [(c, c.end_errors_mm()) for c in comparisons]
    off_mm = np.array([np.abs(ends) for _, ends in ends_mm if ends])
    off_px = np.array([np.abs(ends) / c.pixel_mm() for c, ends in ends_mm if ends])
    percents = np.array([p for c in comparisons if (p := c.picture_percent()) is not None])
    worst = percents[np.abs(percents).argmax()]
    return (
        f"M6's ends are {np.median(off_mm):.1f} mm, {np.median(off_px):.1f} px off the marked ones "
        f"(median); its axis as seen, put at its true height, errs by "
        f"{np.median(np.abs(percents)):.1f} % (median), bias {percents.mean():+.1f}, "
        f"worst {worst:+.1f} %"
    )


def summary(comparisons: list[Comparison], further_fruit: int) -> list[str]:
    """Return what the tables do not say."""
    lines = []
    for kind in ("chord", "centreline"):
        apart = [comparison.truth.apart_percent(kind) for comparison in comparisons]
        median, p90 = np.median(apart), np.percentile(apart, 90)
        lines.append(f"{kind}, marked twice: median {median:.2f} % apart, 90 % within {p90:.2f} %")
    holds, widths = [], []
    flags: Counter[Flag] = Counter()
    for comparison in comparisons:
        if comparison.fruit is None:
            continue
        flags.update(flag for flag in END_FLAGS if flag in comparison.fruit.flags)
        length, true_m = comparison.fruit.length, comparison.truth.cm("centreline") / 100
        if length is not None and length.low_m is not None and length.high_m is not None:
            holds.append(length.low_m <= true_m <= length.high_m)
            widths.append(100 * (length.high_m - length.low_m) / length.value_m)
    coverage, width, median_width = 100 * np.mean(holds), np.mean(widths), np.median(widths)
    width_text = f"width {width:.1f} % (mean), {median_width:.1f} % (median)"
    lines.append(f"{len(holds)} intervals: cover {coverage:.0f} %, {width_text}")
    counts = ", ".join(f"{flag} {flags[flag]}" for flag in END_FLAGS)
    lines.append(f"both ends are in sight, and yet flagged: {counts} of {len(comparisons)}")
    for place in PLACES:
        scales = 100 * (np.array([c.scale for c in comparisons if c.truth.place == place]) - 1)
        lines.append(
            f"{place}: the plane by depth is {np.median(scales):+.2f} % further than by its lines "
            f"({scales.min():+.2f} to {scales.max():+.2f})"
        )
    reads = [(c.read_cm(None), c) for c in comparisons]
    errors = [100 * (read_cm / c.truth.cm("centreline") - 1) for read_cm, c in reads if read_cm]
    cameras = [c.camera_percent() for read_cm, c in reads if read_cm]
    net_errors = np.subtract(errors, cameras)
    lines.append(
        f"depth's scale and the lens alone: {np.mean(cameras):+.2f} %; without them what is "
        f"reported errs by {np.median(np.abs(net_errors)):.2f} % (median), bias "
        f"{np.mean(net_errors):+.2f} (median {np.median(net_errors):+.2f}) %"
    )
    lines.append(ends_and_depth(comparisons))
    sources = Counter(str(c.fruit.mask_source) for c in comparisons if c.fruit is not None)
    lines.append("masks by " + ", ".join(f"{name}: {n}" for name, n in sources.most_common()))
    lines.append(f"{further_fruit} other fruit found")
    return lines


def main() -> None:
    """Measure, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--segmenter", help="as `measure --segmenter`")
    parser.add_argument("--calibration", type=Path, help="as `measure --calibration`")
    parser.add_argument("--input-size", default="", help="as `measure --input-size`")
    arguments = parser.parse_args()
    options = MeasureOptions(
        segmenter=arguments.segmenter,
        calibration=arguments.calibration,
        input_sizes=parse_input_sizes(arguments.input_size),
    )
    comparisons, further_fruit = compare(arguments.folder, options)
    console = Console(width=170, highlight=False)
    console.print(fruit_table(comparisons))
    console.print(methods_table(comparisons))
    for line in summary(comparisons, further_fruit):
        console.print(line, soft_wrap=True)


if __name__ == "__main__":
    main()
