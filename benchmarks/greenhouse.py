"""Cucumbers on the plant before a real D435: recall, precision and lengths.

    python benchmarks/greenhouse.py FOLDER [--confidence 0.2] [--input-size 640] [--end-look]

FOLDER holds `on_plant/` and `intrinsics.json`. `greenhouse_captures.json` holds every cucumber of
which half or more shows, marked by eye, and which captures the detector was trained on. A fruit
counts as found where the box around the measured mask overlaps its own by half (IoU). On eight of
the marked fruit is a green sticker, which no grower's fruit has and which a detector can learn: it
is painted over in the colour picture, and the figures with it come second. The four captures
called sample show one fruit, so their lengths also tell how well a length repeats.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from cucumbervision.capture.source import ReadOptions
from cucumbervision.instances.masks import box_of_mask
from cucumbervision.measurement.flags import Flag
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE
from cucumbervision.perception.input_sizes import parse_input_sizes
from cucumbervision.pipeline.inputs import read_captures
from cucumbervision.pipeline.measurer import Failure, Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_lab.detection.outcomes import match_boxes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.measurement.result import FruitMeasurement
    from cucumbervision.pipeline.measurer import CaptureResult

MARKED = Path(__file__).with_name("greenhouse_captures.json")


@dataclass(frozen=True, eq=False)
class Judged:
    """One capture: its true fruit with what was found of each, and the false positives."""

    name: str
    trained: bool
    fruit: list[tuple[dict[str, Any], FruitMeasurement | None]]
    false: list[FruitMeasurement]

    def hits(self, *, marked: bool) -> tuple[int, int]:
        """Return how many fruit were found, and how many there are."""
        wanted = [found for true, found in self.fruit if true["marked"] or not marked]
        return sum(found is not None for found in wanted), len(wanted)


def judge(result: CaptureResult, marks: dict[str, Any]) -> Judged:
    """Compare what was found in a capture with what is marked in it."""
    found = sorted(result.fruit, key=lambda fruit: -fruit.instance.confidence)
    boxes = [
        fruit.instance.box if fruit.mask is None else box_of_mask(fruit.mask) for fruit in found
    ]
    true = [one["box"] for one in marks["fruit"]]
    matches = match_boxes(boxes, true, ignored=marks["ignored"])
    hits = dict(matches.pairs)
    pairs = [(one, found[hits[k]] if k in hits else None) for k, one in enumerate(marks["fruit"])]
    return Judged(marks["name"], marks["trained"], pairs, [found[k] for k in matches.false])


def without_sticker(color: NDArray[np.uint8], marks: dict[str, Any]) -> NDArray[np.uint8]:
    """Return a capture's colours with the sticker painted over from around it."""
    covered = np.zeros(color.shape[:2], np.uint8)
    for one in marks["fruit"]:
        if "sticker" in one:
            x, y, radius = one["sticker"]
            cv2.circle(covered, (x, y), radius, 1, cv2.FILLED)
    return cv2.inpaint(color, covered, 7, cv2.INPAINT_TELEA)  # type: ignore[return-value]


def length_text(fruit: FruitMeasurement | None) -> str:
    """Return a fruit's confidence, length with its interval, and flags."""
    if fruit is None:
        return "missed"
    length = "no length" if fruit.length is None else f"{100 * fruit.length.value_m:.1f} cm"
    if fruit.length is not None and fruit.length.low_m and fruit.length.high_m:
        length += f" [{100 * fruit.length.low_m:.1f}, {100 * fruit.length.high_m:.1f}]"
    return " ".join([f"{fruit.instance.confidence:.2f}: {length}", *fruit.flags])


def fruit_table(judged: list[Judged]) -> Table:
    """Return one line a fruit, and one a false positive."""
    table = Table("capture", "trained on", "marked", "found", title="Every fruit")
    for one in judged:
        for true, found in one.fruit:
            table.add_row(
                one.name[:26],
                "yes" if one.trained else "no",
                "yes" if true["marked"] else "",
                length_text(found),
            )
        for fruit in one.false:
            table.add_row(one.name[:26], "", "", f"false positive {length_text(fruit)}")
    return table


def summary(judged: list[Judged]) -> list[str]:
    """Return recall, precision, how often `end-hidden` is right, and how sure lengths are."""
    lines = []
    for name, chosen in (
        ("all captures", judged),
        ("captures never trained on", [one for one in judged if not one.trained]),
    ):
        marked, every = (
            np.sum([one.hits(marked=only) for one in chosen], axis=0) for only in (True, False)
        )
        false = sum(len(one.false) for one in chosen)
        lines.append(
            f"{name}: marked fruit {marked[0]} of {marked[1]}, all fruit {every[0]} of "
            f"{every[1]}, false positives {false}, precision {every[0] / (every[0] + false):.2f}"
        )
    ends = [
        (Flag.END_HIDDEN in found.flags or Flag.CUT_BY_FRAME in found.flags) == true["end_hidden"]
        for one in judged
        for true, found in one.fruit
        if found is not None and true["end_hidden"] is not None
    ]
    lines.append(f"a hidden end is flagged, a visible one is not: {sum(ends)} of {len(ends)}")
    repeats = [
        found.length.value_m
        for one in judged
        for true, found in one.fruit
        if one.name.startswith("sample") and true["marked"] and found and found.length
    ]
    lengths = [
        found.length
        for one in judged
        for true, found in one.fruit
        if found is not None and found.length and not found.at_least and not true["end_hidden"]
    ]
    widths = [100 * (k.high_m - k.low_m) / k.value_m for k in lengths if k.high_m and k.low_m]
    lines.append(
        f"90 % intervals of {len(lengths)} fruit without a hidden end: {len(widths)} given, median "
        f"width {np.median(widths):.0f} % of the length, widest {max(widths):.0f} %"
    )
    if len(repeats) > 1:
        spread = 100 * np.std(repeats, ddof=1) / np.mean(repeats)
        lines.append(f"one fruit in {len(repeats)} captures: standard deviation {spread:.1f} %")
    return lines + interval_lines(judged)


def interval_lines(judged: list[Judged]) -> list[str]:
    """Return how wide the intervals are of fruit whose both ends the eye sees, in percent."""
    lengths = [
        fruit.length
        for one in judged
        for true, fruit in one.fruit
        if fruit is not None and fruit.length is not None and true["end_hidden"] is False
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


def main() -> None:
    """Measure, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--confidence", type=float, default=DEFAULT_CONFIDENCE)
    parser.add_argument("--input-size", default="", help="as `measure --input-size`")
    parser.add_argument(
        "--end-look", action=argparse.BooleanOptionalAction, default=MeasureOptions().end_look
    )
    given = parser.parse_args()
    options = MeasureOptions(
        instances="models",
        confidence=given.confidence,
        end_look=given.end_look,
        input_sizes=parse_input_sizes(given.input_size),
    )
    measurer = Measurer(options)
    marks = {one["name"]: one for one in json.loads(MARKED.read_text())["captures"]}
    reading = ReadOptions(intrinsics=given.folder / "intrinsics.json")
    judged, with_stickers = [], []
    for capture in read_captures([given.folder / "on_plant"], reading):
        if isinstance(capture, Failure):
            raise SystemExit(capture.message)
        own = marks[capture.name.removesuffix("_color")]
        with_stickers.append(judge(measurer.measure(capture), own))
        plain = replace(capture, color=without_sticker(capture.color, own))
        judged.append(judge(measurer.measure(plain), own))
    console = Console(width=120, highlight=False)
    console.print(fruit_table(judged))
    for title, ones in (("stickers painted over", judged), ("as captured", with_stickers)):
        console.print(f"\n{title}:")
        for line in summary(ones):
            console.print(line, soft_wrap=True)


if __name__ == "__main__":
    main()
