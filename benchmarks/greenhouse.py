"""Cucumbers on the plant before a real D435: recall, precision and lengths.

    python benchmarks/greenhouse.py FOLDER [--shake] [--end-look]

FOLDER holds `on_plant/` and `intrinsics.json`. `greenhouse_captures.json` holds every cucumber of
which half or more shows, marked by eye, and which captures the detector was trained on. A fruit
counts as found where the box around the measured mask overlaps its own by half (IoU). On eight of
the marked fruit is a green sticker, which no grower's fruit has and which a detector can learn: it
is painted over in the colour picture. The four captures
called sample show one fruit. Both ends of a
fruit are marked in two passes where both are visible; `length_between_m` follows the depth from one
to the other, and lengths and intervals are compared with that. `--shake` measures each capture also
as others take pictures: by a camera mounted on its side, moved, in the dark, at half the size.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares

from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.source import ReadOptions
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import MethodName
from cucumbervision.run.batch import read_captures
from cucumbervision.run.measurer import Failure, Measurer
from cucumbervision.run.options import GRAVITY_BY_EDGE, MeasureOptions
from cucumbervision.tube.shape import points_along, polyline_length
from cucumbervision_lab.evaluate.outcomes import match_boxes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import ArrayLike, NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.methods.result import Fruit
    from cucumbervision.run.measurer import CaptureResult

MARKED = Path(__file__).with_name("greenhouse_captures.json")

_STATIONS = 41  # along a fruit
_CAP = 0.08  # of the length: the surface falls away from a parabola at either end
_DEPTH_SPREAD_M = 0.003


@dataclass(frozen=True, eq=False)
class ComparedCapture:
    """One capture: its true fruit with what was found of each, and the false positives."""

    name: str
    trained: bool
    fruit: list[tuple[dict[str, Any], Fruit | None]]
    false: list[Fruit]
    marked_m: list[tuple[float, float]]
    """Lengths between the ends as marked in two passes, of each fruit; NaN where not marked."""

    def hits(self, *, marked: bool) -> tuple[int, int]:
        """Return how many fruit were found, and how many there are."""
        fruit = [measured for truth, measured in self.fruit if truth["marked"] or not marked]
        return sum(measured is not None for measured in fruit), len(fruit)


def compare(result: CaptureResult, marks: dict[str, Any]) -> ComparedCapture:
    """Compare what was found in a capture with what is marked in it."""
    measured = sorted(result.fruit, key=lambda fruit: -fruit.instance.confidence)
    boxes = [
        fruit.instance.box if fruit.mask is None else box_of_mask(fruit.mask) for fruit in measured
    ]
    true_boxes = [truth["box"] for truth in marks["fruit"]]
    matches = match_boxes(boxes, true_boxes, ignored=marks["ignored"])
    hits = dict(matches.pairs)
    pairs = [
        (truth, measured[hits[k]] if k in hits else None) for k, truth in enumerate(marks["fruit"])
    ]
    false = [measured[k] for k in matches.false]
    marked = [_marked_m(result.capture, truth, fruit) for truth, fruit in pairs]
    return ComparedCapture(marks["name"], marks["trained"], pairs, false, marked)


def _marked_m(capture: Capture, marks: dict[str, Any], fruit: Fruit | None) -> tuple[float, float]:
    m6 = None if fruit is None else fruit.measurements.get(MethodName.M6)
    if "ends" not in marks or m6 is None or m6.fit is None:
        return float("nan"), float("nan")
    traits = m6.fit.traits
    first, second = (
        length_between_m(capture, ends, traits.axis_m, traits.diameter_max_m / 2)
        for ends in marks["ends"]
    )
    return first, second


def without_sticker(color: NDArray[np.uint8], marks: dict[str, Any]) -> NDArray[np.uint8]:
    """Return a capture's colours with the sticker painted over from around it."""
    covered = np.zeros(color.shape[:2], np.uint8)
    for truth in marks["fruit"]:
        if "sticker" in truth:
            x, y, radius = truth["sticker"]
            cv2.circle(covered, (x, y), radius, 1, cv2.FILLED)
    return cv2.inpaint(color, covered, 7, cv2.INPAINT_TELEA)  # type: ignore[return-value]


def moved(
    capture: Capture, marks: dict[str, Any], move: Callable[[Any], Any], place: Callable[..., Any]
) -> tuple[Capture, dict[str, Any]]:
    """Return a capture whose pictures `move` changes, and its marks, whose boxes `place` moves."""
    fruit = [{**truth, "box": place(truth["box"])} for truth in marks["fruit"]]
    for truth in fruit:
        if "ends" in truth:
            truth["ends"] = [[place(2 * end)[:2] for end in ends] for ends in truth["ends"]]
    color, depth_m = (np.ascontiguousarray(move(x)) for x in (capture.color, capture.depth_m))
    lens = capture.intrinsics
    centre = place(2 * [lens.cx_px, lens.cy_px])[:2]
    # A pixel's width and height move as those of a box do.
    left, top, right, bottom = place([0, 0, lens.fx_px, lens.fy_px])
    camera = Intrinsics(color.shape[1], color.shape[0], right - left, bottom - top, *centre)
    moved_marks = {**marks, "fruit": fruit, "ignored": [place(box) for box in marks["ignored"]]}
    return replace(capture, color=color, depth_m=depth_m, intrinsics=camera), moved_marks


def turned(
    capture: Capture, marks: dict[str, Any], quarters: int
) -> tuple[Capture, dict[str, Any]]:
    """Return a capture and its marks turned counterclockwise by quarters."""

    def place(box: ArrayLike) -> list[float]:
        before = Instance(np.array(box, float))
        edges: list[float] = before.turned(quarters, capture.color.shape[:2]).box.tolist()
        return edges

    return moved(capture, marks, lambda picture: np.rot90(picture, quarters), place)


def half_size(capture: Capture, marks: dict[str, Any]) -> tuple[Capture, dict[str, Any]]:
    """Return a capture and its marks at half the size; of four readings of depth one remains."""

    def halved(picture: NDArray[Any]) -> NDArray[Any]:
        if picture.ndim == 2:
            return picture[::2, ::2]
        return np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))

    return moved(capture, marks, halved, lambda box: ((np.array(box) + 0.5) / 2 - 0.5).tolist())


def _noisy(color: NDArray[np.uint8]) -> NDArray[Any]:
    return color + np.random.default_rng(0).normal(0, 16, color.shape)


def _by_jpeg(color: NDArray[np.uint8]) -> NDArray[Any]:
    coded = cv2.imencode(".jpg", color, [cv2.IMWRITE_JPEG_QUALITY, 30])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))


SHAKES: dict[str, Callable[[NDArray[np.uint8]], NDArray[Any]]] = {
    "noise of 16 levels": _noisy,
    "dark: gamma 0.5": lambda color: 255 * (color / 255.0) ** 2,
    "motion of 13 px": lambda color: np.asarray(cv2.blur(color, (13, 1))),
    "JPEG of quality 30": _by_jpeg,
}


def shaken(capture: Capture, marks: dict[str, Any]) -> Iterator[tuple[str, Capture, Any]]:
    """Yield a capture with its marks as others take pictures: turned, small, dark, blurred."""
    yield "as captured", capture, marks
    for quarters, up in enumerate(("left", "bottom", "right"), 1):
        picture, moved_marks = turned(capture, marks, quarters)
        yield f"turned by {90 * quarters} degrees", picture, moved_marks
        known = replace(picture, gravity=GRAVITY_BY_EDGE[up])
        yield f"turned by {90 * quarters} degrees, camera_up known", known, moved_marks
    for title, change in SHAKES.items():
        color = np.clip(np.rint(change(capture.color)), 0, 255).astype(np.uint8)
        yield title, replace(capture, color=color), marks
    yield "half size", *half_size(capture, marks)


def length_text(fruit: Fruit | None) -> str:
    """Return a fruit's confidence, length with its interval, and flags."""
    if fruit is None:
        return "missed"
    length = "no length" if fruit.length is None else f"{100 * fruit.length.value_m:.1f} cm"
    if fruit.length is not None and fruit.length.low_m and fruit.length.high_m:
        length += f" [{100 * fruit.length.low_m:.1f}, {100 * fruit.length.high_m:.1f}]"
    return " ".join([f"{fruit.instance.confidence:.2f}: {length}", *fruit.flags])


def length_between_m(
    capture: Capture, ends_px: ArrayLike, axis_m: NDArray[np.float64], radius_m: float
) -> float:
    """Return the length of a fruit between two marked ends, by the depth along it.

    The picture of a measured axis tells how the fruit bends between the ends, and nothing else. A
    parabola through the depth along that line, to which outliers count little, is the surface; the
    axis lies a radius behind it. NaN where less than half of the fruit has depth.

    Parameters
    ----------
    capture : Capture
        With depth.
    ends_px : array_like, shape (2, 2)
        u, v of both ends, pixels.
    axis_m : ndarray of float64, shape (K, 3)
        The measured axis, camera coordinates.
    radius_m : float
        Of the fruit.
    """
    ends = np.asarray(ends_px, np.float64)
    line = capture.intrinsics.project(points_along(axis_m, np.linspace(0, 1, _STATIONS)))
    if np.linalg.norm(line[0] - ends[0]) > np.linalg.norm(line[-1] - ends[0]):
        line = line[::-1]
    share = np.linspace(0, 1, _STATIONS)
    line = line + (1 - share[:, None]) * (ends[0] - line[0]) + share[:, None] * (ends[1] - line[-1])
    columns, rows = np.rint(line).astype(int).T
    depth = np.array(
        [
            np.median(patch[valid_depth(patch)]) if valid_depth(patch).any() else np.nan
            for x, y in zip(columns, rows, strict=True)
            for patch in [capture.depth_m[max(y - 5, 0) : y + 6, max(x - 5, 0) : x + 6]]
        ]
    )
    inner = (share > _CAP) & (share < 1 - _CAP) & np.isfinite(depth)
    if inner.sum() < len(share) / 2:
        return float("nan")
    terms = np.vander(share, 3)
    first_guess = np.linalg.lstsq(terms[inner], depth[inner], rcond=None)[0]

    def residual_m(shape: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(terms[inner] @ shape - depth[inner])

    fit = least_squares(residual_m, first_guess, loss="soft_l1", f_scale=_DEPTH_SPREAD_M)
    z = terms @ fit.x + radius_m
    x, y = capture.intrinsics.rays(line[:, 0], line[:, 1])
    return polyline_length(np.stack([x * z, y * z, z], axis=1))


def fruit_table(compared: list[ComparedCapture]) -> Table:
    """Return one line a fruit, and one a false positive."""
    table = Table("capture", "marked", "between ends", "found", title="Every fruit")
    for capture in compared:
        for (truth, measured), lengths in zip(capture.fruit, capture.marked_m, strict=True):
            table.add_row(
                capture.name[:26],
                "yes" if truth["marked"] else "",
                "" if np.isnan(lengths[0]) else f"{100 * np.mean(lengths):.1f} cm",
                length_text(measured),
            )
        for fruit in capture.false:
            table.add_row(capture.name[:26], "", "", f"false positive {length_text(fruit)}")
    return table


def summary(compared: list[ComparedCapture]) -> list[str]:
    """Return recall, precision, how often `end-hidden` is right, and how sure lengths are."""
    lines = []
    for name, captures in (
        ("all captures", compared),
        ("captures never trained on", [capture for capture in compared if not capture.trained]),
    ):
        marked, fruit = (
            np.sum([capture.hits(marked=only_marked) for capture in captures], axis=0)
            for only_marked in (True, False)
        )
        false = sum(len(capture.false) for capture in captures)
        lines.append(
            f"{name}: marked fruit {marked[0]} of {marked[1]}, all fruit {fruit[0]} of "
            f"{fruit[1]}, false positives {false}, precision {fruit[0] / (fruit[0] + false):.2f}"
        )
    ends = [
        (Flag.END_HIDDEN in fruit.flags or Flag.CUT_BY_FRAME in fruit.flags) == truth["end_hidden"]
        for capture in compared
        for truth, fruit in capture.fruit
        if fruit is not None and truth["end_hidden"] is not None
    ]
    lines.append(f"a hidden end is flagged, a visible one is not: {sum(ends)} of {len(ends)}")
    return lines + interval_lines(compared) + marked_lines(compared)


def interval_lines(compared: list[ComparedCapture]) -> list[str]:
    """Return how wide the intervals are of fruit whose both ends the eye sees, in percent."""
    lengths = [
        fruit.length
        for capture in compared
        for truth, fruit in capture.fruit
        if fruit is not None and fruit.length is not None and truth["end_hidden"] is False
    ]
    widths = [
        100 * (length.high_m - length.low_m) / length.value_m
        for length in lengths
        if length.low_m and length.high_m
    ]
    if not widths:
        return []
    return [
        f"intervals, both ends in sight: {len(widths)} of {len(lengths)} given, median width "
        f"{np.median(widths):.0f} %, widest {max(widths):.0f} %"
    ]


def marked_lines(compared: list[ComparedCapture]) -> list[str]:
    """Return how far lengths are off those between marked ends, and how many intervals hold."""
    pairs = [
        (fruit.length, lengths)
        for capture in compared
        for (_, fruit), lengths in zip(capture.fruit, capture.marked_m, strict=True)
        if fruit is not None and fruit.length is not None and not np.isnan(lengths).any()
    ]
    if not pairs:
        return []
    passes = np.array([lengths for _, lengths in pairs])
    marked = passes.mean(axis=1)
    errors = 100 * (np.array([length.value_m for length, _ in pairs]) / marked - 1)
    holds = [
        length.low_m <= marked_length <= length.high_m
        for (length, _), marked_length in zip(pairs, marked, strict=True)
        if length.low_m is not None and length.high_m is not None
    ]
    differences = 100 * np.abs(passes[:, 1] - passes[:, 0]) / marked
    worst = errors[np.abs(errors).argmax()]
    return [
        f"length between marked ends, {len(pairs)} fruit: off by {np.median(np.abs(errors)):.1f} % "
        f"(median), {worst:+.1f} % (worst), {errors.mean():+.1f} % (mean); "
        f"intervals hold {sum(holds)} of {len(holds)}; the passes differ by "
        f"{np.median(differences):.1f} % (median)"
    ]


def main() -> None:
    """Measure, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--shake", action="store_true", help="also turned, small, dark, blurred")
    parser.add_argument(
        "--end-look", action=argparse.BooleanOptionalAction, default=MeasureOptions().end_look
    )
    arguments = parser.parse_args()
    measurer = Measurer(MeasureOptions(instances="models", end_look=arguments.end_look))
    compared: defaultdict[str, list[ComparedCapture]] = defaultdict(list)
    marks = {capture["name"]: capture for capture in json.loads(MARKED.read_text())["captures"]}
    reading = ReadOptions(intrinsics=arguments.folder / "intrinsics.json")
    for capture in read_captures([arguments.folder / "on_plant"], reading):
        if isinstance(capture, Failure):
            raise SystemExit(capture.message)
        truth = marks[capture.name.removesuffix("_color")]
        plain = replace(capture, color=without_sticker(capture.color, truth))
        for title, picture, moved_marks in shaken(plain, truth):
            compared[title].append(compare(measurer.measure(picture), moved_marks))
            if not arguments.shake:
                break
    console = Console(width=120, highlight=False)
    for title, group in compared.items():
        if not arguments.shake:
            console.print(fruit_table(group))
        console.print(f"\n{title}:")
        for line in summary(group):
            console.print(line, soft_wrap=True)


if __name__ == "__main__":
    main()
