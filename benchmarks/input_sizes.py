r"""What the detector finds at several input sizes, and what each costs, side by side in one run.

    python benchmarks/input_sizes.py --photos DIR --set SET --split val \
        --size 640 --size 1280 --size 640,1280 [--confidence 0.3] [--limit 40] [--seg SEG.onnx] \
        [--no-pose | --pose POSE.onnx]

Recall and precision on the audited photos of a split (at full size and at half of it) and on a
labelled set with masks, by hidden share. Each picture is seen once at each size; merged sizes and
confidences are made of the same finds. Of the photos also what the best F1 of the one half of the
scenes (size and confidence chosen there, mean of full and half size) reaches on the other half: a
figure for pictures that chose nothing. Processor milliseconds of all threads for a frame of
1280x720, with every runtime that is here in turns: on a busy machine the clock on the wall says
little.
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.files import read_color
from cucumbervision.errors import CucumberVisionError
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE, detector_floor, pose_floor
from cucumbervision.perception.input_sizes import merge_sizes, parse_input_sizes
from cucumbervision.perception.yolo import YoloDetector
from cucumbervision_lab.detection.outcomes import (
    HIDDEN_SHARE,
    found_rows,
    fruit_rows,
    group_scores,
    overall,
)
from cucumbervision_lab.detection.photos import audited_photos, half_size
from cucumbervision_lab.detection.picture_result import MOST, shipped
from cucumbervision_lab.detection.pictures import (
    capture_of,
    frame_of,
    read_held_out,
    seen_fruit,
    spread,
)
from cucumbervision_lab.detection.run import chosen_networks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_lab.detection.pictures import Frame

RUNTIMES = ("onnxruntime", "openvino")
FRAME_PX = (720, 1280)

PHOTOS, HALF = "photos", "photos at half size"

Sizes = tuple[int, ...]
Frames = dict[str, dict[tuple[Sizes, float], list["Frame"]]]


@dataclass(frozen=True, eq=False)
class Shown:
    """One picture: the test that it is of, its truth, colour and depth."""

    test: str
    truth: Frame
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32] | None = None


def pictures(options: argparse.Namespace) -> Iterator[Shown]:
    """Yield the pictures, one at a time: photos, photos at half size, drawn frames."""
    if options.photos is not None:
        photos, _ = audited_photos(options.photos, options.split)
        for photo in spread(tuple(photos), options.limit):
            color = read_color(photo.path)
            yield Shown(PHOTOS, photo.truth, color)
            if options.half:
                yield Shown(HALF, *half_size(photo.truth, color))
    if options.set is not None:
        held_out = read_held_out(options.set, options.split, options.limit)
        for picture in held_out.pictures:
            color = read_color(held_out.data.path(picture))
            capture = capture_of(picture, held_out.data, color)
            depth_m = None if capture is None else capture.depth_m
            yield Shown("drawn", frame_of(picture, held_out.data, depth_m), color, depth_m)


def detector(path: Path, runtime: str, sizes: Sizes, confidence: float) -> YoloDetector:
    """Open the detector."""
    return YoloDetector(
        path, runtime, confidence, full_precision=True, most=MOST, input_sizes=sizes
    )


def found_at(
    path: Path,
    pose: YoloDetector | None,
    asked: Sequence[Sizes],
    confidences: Sequence[float],
    shown: Iterator[Shown],
) -> Frames:
    """Return the frames by test, and by what was asked."""
    # Both its sizes and the pose network have a vote.
    least = detector_floor(detector_floor(min(confidences), votes=True), votes=True)
    single = {size: detector(path, "auto", (size,), least) for sizes in asked for size in sizes}
    frames: Frames = {}
    for one in shown:
        seen = {size: network.detect(one.color) for size, network in single.items()}
        posed = None if pose is None else pose.detect(one.color)
        for sizes in asked:
            every = merge_sizes([seen[size] for size in sizes])
            for confidence in confidences:
                kept = shipped(every, posed, confidence, one.color, one.depth_m, looks=len(sizes))
                frame = replace(one.truth, kept=tuple(seen_fruit(fruit) for fruit in kept))
                frames.setdefault(one.test, {}).setdefault((sizes, confidence), []).append(frame)
    return frames


def f1(frames: Sequence[Frame], confidence: float) -> float:
    """Return the harmonic mean of recall and precision."""
    score = overall(fruit_rows(frames, confidence), found_rows(frames, confidence))
    recall = score.recall.value
    precision = 0.0 if score.precision is None else score.precision.value
    return 2 * recall * precision / (recall + precision) if recall + precision else 0.0


def chosen_by_halves(frames: Frames) -> Iterator[str]:
    """Say what the best of each half of the scenes reaches on the other."""
    photos = {test: frames[test] for test in (PHOTOS, HALF) if test in frames}

    def part(some: Sequence[Frame], half: int) -> list[Frame]:
        return [one for one in some if zlib.crc32(one.scene.encode()) % 2 == half]

    def mean_f1(asked: tuple[Sizes, float], half: int) -> float:
        return float(np.mean([f1(part(some[asked], half), asked[1]) for some in photos.values()]))

    for half in (0, 1):
        best = max(photos[PHOTOS], key=lambda asked: mean_f1(asked, half))
        yield f"{name(best)}: F1 {mean_f1(best, half):.3f} there; on the other half of the scenes"
        for test, some in photos.items():
            yield f"    {test}: {line(part(some[best], 1 - half), best[1])}"


def name(asked: tuple[Sizes, float]) -> str:
    """Return sizes and confidence as text."""
    return f"{'+'.join(map(str, asked[0])):>10} px, {asked[1]:.2f}"


def busy_ms(path: Path, sizes: Sizes, turns: int) -> dict[str, float]:
    """Return the median processor time of one frame by runtime."""
    color = np.random.default_rng(0).integers(0, 255, (*FRAME_PX, 3), np.uint8)
    networks: dict[str, YoloDetector] = {}
    for runtime in RUNTIMES:
        try:
            networks[runtime] = detector(path, runtime, sizes, DEFAULT_CONFIDENCE)
        except CucumberVisionError as error:
            print(f"left out: {error}")
    times: dict[str, list[float]] = {runtime: [] for runtime in networks}
    for turn in range(turns + 1):
        for runtime, network in networks.items():
            start = time.process_time()
            network.detect(color)
            # The first turn sets the runtime up.
            if turn:
                times[runtime].append(1e3 * (time.process_time() - start))
    return {runtime: float(np.median(some)) for runtime, some in times.items()}


def line(frames: Sequence[Frame], confidence: float) -> str:
    """Return recall, precision and recall by hidden share as text."""
    fruit, found = fruit_rows(frames, confidence), found_rows(frames, confidence)
    score = overall(fruit, found)
    precision = score.precision.value if score.precision is not None else float("nan")
    text = f"recall {score.recall.value:.3f} of {score.recall.count}, precision {precision:.3f}"
    hidden = [one for one in group_scores(fruit, found) if one.factor == HIDDEN_SHARE]
    shares = [f"{one.group} %: {one.recall.value:.2f} of {one.recall.count}" for one in hidden]
    return text + ("; hidden " + ", ".join(shares) if shares else "")


def main() -> None:
    """Read the arguments, look at every picture, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=Path, help="folder of the audited photos")
    parser.add_argument("--set", type=Path, help="a labelled set")
    parser.add_argument("--split", default="val")
    parser.add_argument("--size", action="append", help="640, or 640,1280; repeatable")
    parser.add_argument("--confidence", type=float, action="append", help="repeatable")
    parser.add_argument("--limit", type=int, help="pictures at most of each test, evenly spread")
    parser.add_argument("--half", action="store_true", help="photos at half their size too")
    parser.add_argument("--seg", type=Path, help="a detector; else the package's own")
    parser.add_argument("--pose", type=Path, help="a pose network; else the package's own")
    parser.add_argument("--no-pose", action="store_true", help="without the pose network's votes")
    parser.add_argument("--turns", type=int, default=5, help="of timing")
    options = parser.parse_args()
    path, points = chosen_networks(options.seg, options.pose)
    if path is None:
        raise SystemExit("this version comes without a detector: name one with --seg")
    asked = [parse_input_sizes(text) for text in options.size or ("640", "960", "1280", "640,1280")]
    confidences = options.confidence or [DEFAULT_CONFIDENCE]
    pose = None
    if points is not None and not options.no_pose:
        pose = YoloDetector(
            points, "auto", pose_floor(min(confidences)), full_precision=True, most=MOST
        )
    frames = found_at(path, pose, asked, confidences, pictures(options))
    for test, by_asked in frames.items():
        count = len(next(iter(by_asked.values())))
        print(f"\n{test}: {count} pictures, split {options.split}")
        for one, some in by_asked.items():
            print(f"{name(one)}  F1 {f1(some, one[1]):.3f}, {line(some, one[1])}")
    if PHOTOS in frames and len(frames[PHOTOS]) > 1:
        print("\nchosen on one half of the scenes, judged on the other")
        print("\n".join(chosen_by_halves(frames)))
    print("\nprocessor ms a frame of 1280x720, detector alone")
    for sizes in asked:
        costs = busy_ms(path, sizes, options.turns)
        text = ", ".join(f"{runtime} {cost:.0f}" for runtime, cost in costs.items())
        print(f"{'+'.join(map(str, sizes)):>10} px  {text}")


if __name__ == "__main__":
    main()
