"""A house whose fruit look unlike ours teaches its detector: recall before and after.

    OMP_NUM_THREADS=1 python tests/scenarios/teaching_house.py --out RUN ...

The house is drawn: yellow fruit with green stripes, under warm lamps. Its captures go through the
real pipeline into a store, where they are corrected as a user would, by the truth: finds that hit
no fruit are rejected, fruit that were missed are added by a box or a tap, which SAM draws, masks
far off are corrected, the other finds of the picture accepted. After 30, 100 and 300 corrections
`data from-store` and `train house` do what they do. All networks are judged on the places that the
last set keeps back, on drawn frames and, with `--photos`, on the audited photos; with `--beside`
those of train scenes are trained on, too, as the shipped mixture has them. What is done already is
not done again.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import InstancesError
from cucumbervision.files import read_json
from cucumbervision.instances.boxes import box_iou
from cucumbervision.instances.mask_codes import decode_rle
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE
from cucumbervision.perception.registry import load_registry
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_greenhouse.backend.measuring import SharedMeasurer
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.rounds.stop_records import stored_capture
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.views import DetectionFilter, DetectionSummary, Verdict
from cucumbervision_lab.datasets.coco import picture_of, write_fragment
from cucumbervision_lab.datasets.derive import dataset_from_store
from cucumbervision_lab.datasets.labels import Label
from cucumbervision_lab.synthesis.appearance import Assets, Style
from cucumbervision_lab.synthesis.frame import FrameOptions, draw_frame
from cucumbervision_lab.synthesis.generate import label_frame
from cucumbervision_lab.training.house import (
    DetectorScore,
    HousePlan,
    evaluate_detector,
    train_house,
)
from cucumbervision_lab.training.settings import TrainOptions

SKIN = {
    "base": (232.0, 206.0, 96.0),
    "tip": (238.0, 214.0, 120.0),
    "stripe": (96.0, 110.0, 40.0),
    "stripes": 9,
    "stripe_strength": 0.7,
    "stripe_reach": 1.3,
    "neck": 0.3,
    "texture": -1,
}
LAMPS = {
    "environment": -1,
    "sun_color": (1.55, 0.95, 0.5),
    "zenith": (250.0, 196.0, 140.0),
    "horizon": (190.0, 140.0, 100.0),
    "ground": (90.0, 70.0, 50.0),
}
SEED = 4242
FRAME = FrameOptions(640, 480, (1.0, 0.0, 0.0), hard=True)
STOPS_A_ROW = 25
WALK = Round(key_of("teaching house"), "morning", "drawn house", 1000.0)
OPTIONS = MeasureOptions(instances="models")
HIT = 0.5  # overlap of boxes from which a find is that fruit
GOOD_MASK = 0.6  # overlap of masks under which a user draws anew
AT_ONCE = 10  # captures measured before the user comes
MOST_HIDDEN = 0.75  # of a fruit that a user would still mark


def as_this_house(style: Style) -> Style:
    """Return a frame's look with this house's skin and light; what is no cucumber is as before."""
    decoys = [skin.base == skin.tip == skin.stripe for skin in style.skins]
    skins = tuple(
        skin if decoy else replace(skin, **SKIN)  # type: ignore[arg-type]
        for skin, decoy in zip(style.skins, decoys, strict=True)
    )
    return replace(style, skins=skins, light=replace(style.light, **LAMPS))  # type: ignore[arg-type]


def draw_house(out: Path, stops: int) -> None:
    """Write `captures/NNN`, a native capture a stop, and `truth/NNN.json`, its labels."""
    for number in range(stops):
        name = f"stop-{number:03d}"
        truth = out / "truth" / f"{name}.json"
        if truth.exists():
            continue
        frame = draw_frame(SEED, number, FRAME, Assets(), as_this_house)
        assert frame.depth_m is not None
        row, step = divmod(number, STOPS_A_ROW)
        place = Stop(str(row + 1), "left", float(step), step + 1)
        write_native(
            Capture(frame.color, frame.depth_m, frame.camera, name, stop=place, simulated=True),
            out / "captures" / name,
        )
        write_fragment(label_frame(frame, name, name, "test"), truth)


def true_fruit(house: Path, name: str) -> tuple[Label, ...]:
    """Read the labels of a stop."""
    path = house / "truth" / f"{name}.json"
    values = read_json(path)
    return picture_of(values["image"], values["annotations"], {1: 0}, path)[0].labels


def mask_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Compute the intersection over union of two masks."""
    return float((a & b).sum() / max((a | b).sum(), 1))


class User:
    """Corrects a store by the truth, through what the dashboard offers, and counts what it did."""

    def __init__(self, store: Store, house: Path) -> None:
        self.store, self.house = store, house
        self.measurer = SharedMeasurer(load_registry())
        self.corrections = sum(
            line.kind in ("add", "correct") or len(line.fruit) * (line.kind == "reject")
            for line in store.log(WALK.key, limit=None)
            if not line.undone
        )

    def judge_stop(self, stop_key: str) -> None:
        """Judge all finds of a stop, and add what was missed."""
        stop = self.store.stop(stop_key)
        (record,) = stop.captures
        capture = stored_capture(self.store.images, record, stop)
        true = true_fruit(self.house, record.name)
        views = self.store.detections(WALK.key, DetectionFilter(stop_key=stop_key))
        hit_by, wrong = self._matched(views, true)
        masks = {fruit.number: fruit.mask for fruit in record.fruit}
        if wrong:  # first, since no fruit is added where a find still stands
            self.store.set_verdict(wrong, Verdict.REJECTED)
            self.corrections += len(wrong)
        for k, label in enumerate(true):
            view = hit_by.get(k)
            if view is not None:
                code = masks[view.record.number]
                mask = None if code is None else decode_rle(code, capture.height, capture.width)
                if label.ignore or (mask is not None and self._is_good(mask, label)):
                    continue
            if label.ignore or (view is None and (label.hidden_share or 0) > MOST_HIDDEN):
                continue
            drawn = self._drawn(capture, label)
            if drawn is None:
                continue
            try:
                if view is None:
                    added = self.measurer.add(self.store, stop, capture, drawn, OPTIONS)
                    # What does not look like a fruit to the program waits for this.
                    self.store.set_verdict([added], Verdict.ACCEPTED)
                else:
                    detail = self.store.detection(view.key)
                    self.measurer.correct(self.store, detail, capture, drawn, OPTIONS)
            except InstancesError:  # SAM draws a neighbour that is there already
                continue
            self.corrections += 1
        rest = [one.key for one in views if one.key not in wrong]
        if rest:
            self.store.set_verdict(rest, Verdict.ACCEPTED)

    @staticmethod
    def _matched(
        views: Sequence[DetectionSummary], true: Sequence[Label]
    ) -> tuple[dict[int, DetectionSummary], list[str]]:
        """Return the find of each fruit that was hit, and the keys of those that hit none."""
        hit_by: dict[int, DetectionSummary] = {}
        wrong = []
        for view in sorted(views, key=lambda one: -one.record.score):
            record = view.record
            box = np.array([record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px])
            free = {k: box_iou(one.box, box) for k, one in enumerate(true) if k not in hit_by}
            best = max(free, key=lambda k: free[k], default=-1)
            if best >= 0 and free[best] >= HIT:
                hit_by[best] = view
            else:
                wrong.append(view.key)
        return hit_by, wrong

    def _drawn(self, capture: Capture, label: Label) -> NDArray[np.bool_] | None:
        """Return what SAM draws for a box about the fruit, or else for a tap on it."""
        true = label.mask
        assert true is not None
        x1, y1, x2, y2 = (float(v) for v in label.box)
        ys, xs = np.nonzero(true)
        middle = len(xs) // 2
        tap, box = (float(xs[middle]), float(ys[middle])), (x1, y1, x2, y2)
        for of_box in (True, False):
            try:
                if of_box:
                    mask = self.measurer.mask_from_box(capture, box)
                else:
                    mask = self.measurer.mask_from_click(capture, tap)
            except InstancesError:
                continue
            if mask_iou(mask, true) >= GOOD_MASK:
                return mask
        return None  # a user gives up

    @staticmethod
    def _is_good(mask: NDArray[np.bool_], label: Label) -> bool:
        return label.mask is not None and mask_iou(mask, label.mask) >= GOOD_MASK


def correct_house(out: Path, marks: Sequence[int]) -> list[Path]:
    """Measure the house into a store, correct it stop by stop, and write a set at each mark."""
    house = out / "house"
    sets = [out / f"set-{mark}" for mark in marks]
    with open_store(out / "house.db") as store:
        store.save_round(WALK)
        names = sorted(path for path in (house / "captures").iterdir())
        user = User(store, house)
        views = store.detections(WALK.key)
        judged = {view.stop_key for view in views} - {
            view.stop_key for view in views if not view.verdict
        }
        waiting = [
            (mark, path)
            for mark, path in zip(marks, sets, strict=True)
            if not (path / "annotations.json").is_file()
        ]
        for at in range(0, len(names), AT_ONCE):
            if not waiting:
                break
            for added in add_captures(store, WALK.key, names[at : at + AT_ONCE], OPTIONS):
                if added.failure is None and added.stop_key not in judged:
                    user.judge_stop(added.stop_key)
                while waiting and user.corrections >= waiting[0][0]:
                    _, path = waiting.pop(0)
                    made = dataset_from_store(store, path)
                    said = {split: one.corrections for split, one in made.judged.items()}
                    print(
                        f"{user.corrections} corrections: {len(made.dataset.pictures)} pictures; "
                        f"corrections by split {said}",
                        flush=True,
                    )
    return [path for path in sets if (path / "annotations.json").is_file()]


def lines_of(name: str, judged: Sequence[DetectorScore]) -> str:
    """Return a row of the table: recall and precision of each test."""
    return f"| {name} | " + " | ".join(f"{x.recall:.2f}, {x.precision:.2f}" for x in judged) + " |"


def main() -> None:
    """Draw, correct, train, judge, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--photos", type=Path, help="audited photos to judge on")
    parser.add_argument("--beside", action="store_true", help="train on the shipped photos, too")
    parser.add_argument("--init", type=Path, default=Path("checkpoints/cucumber-seg.pt"))
    parser.add_argument("--stops", type=int, default=130)
    parser.add_argument("--corrections", default="30,100,300")
    parser.add_argument("--plan", default="448x600")
    parser.add_argument("--learning-rate", type=float, default=HousePlan.learning_rate)
    parser.add_argument("--share", type=float, default=HousePlan.share, help="the house's")
    parser.add_argument("--drawn", type=int, default=60, help="frames a source of the mixture")
    parser.add_argument("--tested", type=int, default=30, help="drawn frames and photos judged on")
    parser.add_argument("--per-epoch", type=int, default=200)
    parser.add_argument("--threads", type=int, default=1)
    asked = parser.parse_args()
    began = time.monotonic()
    marks = [int(mark) for mark in asked.corrections.split(",")]
    draw_house(asked.out / "house", asked.stops)
    sets = correct_house(asked.out, marks)
    plan = HousePlan(
        asked.plan,
        asked.share,
        drawn=asked.drawn,
        windows=(240,),
        tested=asked.tested,
        per_epoch=asked.per_epoch,
        learning_rate=asked.learning_rate,
    )
    options = TrainOptions(threads=asked.threads, validate_every=1000)
    tests = sets[-1], asked.out / "run-1" / "test", asked.photos, asked.tested
    table: list[str] = []
    for number, house in enumerate(sets, 1):
        run = asked.out / f"run-{number}"
        for first in (asked.out / "run-1" / "data").glob("*"):
            own = run / "data" / first.name
            # The shipped mixture's drawn frames are the same in every run.
            if not (own.exists() or first.name.startswith("house")):
                shutil.copytree(first, own)
        train_house(
            house,
            run,
            photos=asked.photos if asked.beside else None,
            init=asked.init,
            plan=plan,
            options=options,
            log=lambda _: None,
        )
        if not table:
            old = evaluate_detector(
                Path(load_registry().resolve("cucumber-seg")["network"]), *tests
            )
            heads = " | ".join(f"{one.test} ({one.fruit})" for one in old)
            table += [f"| corrections | {heads} |", "|---" + "|--:" * len(old) + "|"]
            table.append(lines_of("0: as shipped", old))
        table.append(
            lines_of(
                house.name.removeprefix("set-"), evaluate_detector(run / "house-seg.onnx", *tests)
            )
        )
        print("\n".join(table), flush=True)
        print((run / "judgement.md").read_text(encoding="utf-8").splitlines()[-1], flush=True)
    seconds = time.monotonic() - began
    print(f"recall, precision at {DEFAULT_CONFIDENCE} (of how many fruit); {seconds:.0f} s")


if __name__ == "__main__":
    main()
