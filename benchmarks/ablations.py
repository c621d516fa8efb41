"""What each rescoring of a detection is worth: recall and precision with it and without it.

    python benchmarks/ablations.py PHOTOS ON_PLANT DRAWN OTHER... [--split test] [--confidence 0.2]

PHOTOS holds the audited photos (as `evaluate photos`, at full and at half size), ON_PLANT the D435
captures of `greenhouse.py`, DRAWN a labelled set with depth (as `evaluate models`), OTHER captures
without cucumbers. Every line of the table leaves one step out. A step also shifts the confidences,
so each line gives recall and false positives at one threshold, by default that in use, and the best
F1 score of any threshold. A step may also bring the tests to one scale: then the best thresholds
without it differ between tests. The passes of the networks over a picture are shared by all lines;
the processor time of a line counts them in full.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from cucumbervision.capture.pictures import read_color
from cucumbervision.capture.source import ReadOptions
from cucumbervision.networks.confidence import DEFAULT_CONFIDENCE
from cucumbervision.networks.looks import PictureLooks
from cucumbervision.networks.yolo import YoloDetector
from cucumbervision.run.inputs import read_captures
from cucumbervision.run.measurer import Failure
from cucumbervision_lab.evaluate.outcomes import match_detections
from cucumbervision_lab.evaluate.photos import audited_photos, half_size
from cucumbervision_lab.evaluate.picture_result import Networks, merge_detections, open_networks
from cucumbervision_lab.evaluate.pictures import (
    DetectedFruit,
    Frame,
    Stage,
    TrueFruit,
    capture_of,
    frame_of,
    read_held_out,
)
from cucumbervision_lab.evaluate.scenes import chosen_networks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray


MARKED = Path(__file__).with_name("greenhouse_captures.json")
THRESHOLDS = (0.05, 0.1, 0.15, DEFAULT_CONFIDENCE, 0.25, 0.3, 0.4, 0.5, 0.6)


@dataclass(frozen=True, eq=False)
class Scene:
    """A labelled picture, with depth where there is any."""

    test: str
    truth: Frame
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32] | None = None
    focal_px: float | None = None


@dataclass(frozen=True)
class Ablation:
    """A step that is left out: the replaced functions, and what else changes."""

    name: str
    replaced: tuple[tuple[Any, str, Any], ...] = ()
    single_size: bool = False


@dataclass
class Score:
    """Hits and false positives by threshold, the number of fruit, and processor time."""

    hits: NDArray[np.int_] = field(default_factory=lambda: np.zeros(len(THRESHOLDS), int))
    false: NDArray[np.int_] = field(default_factory=lambda: np.zeros(len(THRESHOLDS), int))
    fruit: int = 0
    seconds: float = 0.0

    def best_f1(self) -> float:
        """Return the best F1 score of any threshold."""
        return float(np.max(2 * self.hits / (self.hits + self.false + self.fruit)))


class SharedPasses:
    """Passes of a network over the current picture, computed once, with their processor time."""

    def __init__(self) -> None:
        self._pass = YoloDetector._detect_at
        self._passes: dict[tuple[Any, ...], Any] = {}
        self.computed_s = self.used_s = 0.0

    def clear(self) -> None:
        """Forget the passes over the last picture."""
        self._passes.clear()

    def __get__(self, network: YoloDetector, owner: type) -> Callable[..., Any]:
        def detect_at(
            color: NDArray[np.uint8], size_px: tuple[int, int], confidence: float
        ) -> tuple[Any, ...]:
            key = (id(network), size_px, confidence, color.tobytes())
            if key not in self._passes:
                start = time.process_time()
                detections = self._pass(network, color, size_px, confidence)
                self._passes[key] = detections, time.process_time() - start
                self.computed_s += self._passes[key][1]
            self.used_s += self._passes[key][1]
            return self._passes[key][0]  # type: ignore[no-any-return]

        return detect_at


def ablations() -> list[Ablation]:
    """Return every line of the table."""
    no_close_look = (PictureLooks, "rescore", lambda _, instances: tuple(instances))
    return [
        Ablation("as shipped"),
        Ablation("without the second size", single_size=True),
        Ablation("without the close look's vote", (no_close_look,)),
    ]


def scenes(
    photos: Path, on_plant: Path, drawn: Path, other: Sequence[Path], split: str
) -> Iterator[Scene]:
    """Yield the pictures of all tests."""
    for photo in audited_photos(photos, split)[0]:
        color = read_color(photo.path)
        yield Scene("photos", photo.truth, color)
        yield Scene("photos, half size", *half_size(photo.truth, color))
    marks = {entry["name"]: entry for entry in json.loads(MARKED.read_text())["captures"]}
    reading = ReadOptions(intrinsics=on_plant / "intrinsics.json")
    for capture in read_captures([on_plant / "on_plant"], reading):
        if isinstance(capture, Failure):
            raise SystemExit(capture.message)
        mark = marks[capture.name.removesuffix("_color")]
        boxes = [fruit["box"] for fruit in mark["fruit"]]
        true = [TrueFruit(np.asarray(box, float)) for box in boxes]
        true += [TrueFruit(np.asarray(box, float), ignore=True) for box in mark["ignored"]]
        height, width = capture.color.shape[:2]
        truth = Frame(capture.name, capture.name, width, height, tuple(true))
        yield Scene(
            "D435 on the plant", truth, capture.color, capture.depth_m, capture.intrinsics.fx_px
        )
    held_out = read_held_out(drawn, "all")
    for picture in held_out.pictures:
        color = read_color(held_out.path(picture))
        capture_ = capture_of(picture, held_out, color)
        depth_m = None if capture_ is None else capture_.depth_m
        focal_px = None if capture_ is None else capture_.intrinsics.fx_px
        yield Scene("drawn", frame_of(picture, held_out, depth_m), color, depth_m, focal_px)
    for folder in other:
        intrinsics = folder / "intrinsics.json"
        reading = ReadOptions(intrinsics=intrinsics if intrinsics.exists() else None)
        for capture in read_captures([folder], reading):
            if isinstance(capture, Failure):
                raise SystemExit(capture.message)
            height, width = capture.color.shape[:2]
            truth, focal_px = (
                Frame(capture.name, capture.name, width, height),
                capture.intrinsics.fx_px,
            )
            yield Scene("other things", truth, capture.color, capture.depth_m, focal_px)


@contextmanager
def replacing(functions: Iterable[tuple[Any, str, Any]]) -> Iterator[None]:
    """Replace functions of modules and classes."""
    with ExitStack() as stack:
        for owner, name, function in functions:
            owner = resolve_name(owner) if isinstance(owner, str) else owner
            stack.enter_context(patch.object(owner, name, function))
        yield


def score_scene(
    scene: Scene, ablation: Ablation, networks: Networks, passes: SharedPasses, score: Score
) -> None:
    """Add one picture to a score."""
    score.fruit += sum(fruit.required for fruit in scene.truth.true)
    with replacing(ablation.replaced):
        computed_s, used_s, start = passes.computed_s, passes.used_s, time.process_time()
        assert networks.segment is not None
        assert networks.fruit is not None
        segmented = networks.segment.detect(scene.color)
        looks = networks.fruit.on(scene.color, scene.depth_m, scene.focal_px)
        looked = looks.rescore(segmented)
        by_detection = dict(zip(map(id, segmented), looked, strict=True))
        score.seconds += passes.used_s - used_s - (passes.computed_s - computed_s)
        score.seconds += time.process_time() - start
        for k, threshold in enumerate(THRESHOLDS):
            start = time.process_time()
            instances = merge_detections(
                segmented,
                None,
                threshold,
                scene.depth_m,
                look=lambda detections: [by_detection[id(x)] for x in detections],
            )
            if threshold == DEFAULT_CONFIDENCE:
                score.seconds += time.process_time() - start
            kept = tuple(DetectedFruit(fruit.box, fruit.confidence) for fruit in instances)
            frame = replace(scene.truth, kept=kept)
            matches, _, _ = match_detections(frame, threshold, Stage.KEPT)
            score.hits[k] += len(matches.pairs)
            score.false[k] += len(matches.false)


def score_table(scores: dict[tuple[str, str], Score], tests: list[str], confidence: float) -> Table:
    """Return one line an ablation: recall and false positives by test, best F1, time."""
    table = Table("step", *tests, "processor time", title="found / fruit, false positives; best F1")
    in_use = THRESHOLDS.index(confidence)
    names = list(dict.fromkeys(name for name, _ in scores))
    whole_s = sum(scores[names[0], test].seconds for test in tests)
    for name in names:
        row = [scores[name, test] for test in tests]
        cells = [
            f"{score.hits[in_use]} / {score.fruit}, {score.false[in_use]}; {score.best_f1():.3f}"
            if score.fruit
            else f"{score.false[in_use]}"
            for score in row
        ]
        share = 100 * sum(score.seconds for score in row) / whole_s
        table.add_row(name, *cells, f"{share:.0f} %")
    return table


def main() -> None:
    """Run every ablation on every test, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("on_plant", type=Path)
    parser.add_argument("drawn", type=Path)
    parser.add_argument("other", type=Path, nargs="+")
    parser.add_argument("--split", default="test", help="of the photos")
    parser.add_argument("--confidence", type=float, default=DEFAULT_CONFIDENCE, choices=THRESHOLDS)
    paths = parser.parse_args()
    lines = ablations()
    chosen = chosen_networks(None, None)
    shipped = open_networks(*chosen, None, ranked=False)
    assert shipped.segment is not None
    assert shipped.fruit is not None
    long_side_px = max(shipped.segment._sizes_px[0])
    single = open_networks(chosen[0], None, None, ranked=False, input_sizes=(long_side_px,))
    scores: dict[tuple[str, str], Score] = {}
    passes = SharedPasses()
    with patch.object(YoloDetector, "_detect_at", passes):
        pictures = scenes(paths.photos, paths.on_plant, paths.drawn, paths.other, paths.split)
        for scene in track(pictures, "pictures", total=None):
            passes.clear()
            for line in lines:
                score = scores.setdefault((line.name, scene.test), Score())
                networks = single if line.single_size else shipped
                score_scene(scene, line, networks, passes, score)
    kinds = list(dict.fromkeys(test for _, test in scores))
    console = Console(width=150, highlight=False)
    console.print(score_table(scores, kinds, paths.confidence))


if __name__ == "__main__":
    main()
