"""Detections that are wrong by a known amount, and what is said of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

pytest.importorskip("pycocotools")

from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision_lab.data.labels import Label
from cucumbervision_lab.evaluate.outcomes import (
    OKS_SIGMA,
    IouType,
    average_precision,
    detection_rows,
    end_rows,
    fruit_rows,
    group_scores,
    match_boxes,
    overall,
)
from cucumbervision_lab.evaluate.pictures import Frame, detected_label

BOX = np.array([99.5, 99.5, 199.5, 119.5])
AWAY = BOX + np.array([0, 200, 0, 200])
LINE = np.column_stack([np.linspace(100, 200, 5), np.full(5, 110.0), np.full(5, 2.0)])


def frame(
    true: list[Label], found: list[Label], name: str = "a", posed: tuple[Label, ...] = ()
) -> Frame:
    return Frame(name, name, 640, 480, tuple(true), (), posed, tuple(found))


def mask(left: int, right: int) -> NDArray[np.bool_]:
    out = np.zeros((480, 640), bool)
    out[100:120, left:right] = True
    return out


def test_what_becomes_of_a_fruit() -> None:
    true = Label(
        BOX, mask_code=Rle.of(mask(100, 200)), hidden_share=0.2, cut_off=False, distance_m=0.6
    )
    fruit = Label(BOX + np.array([20, 0, 20, 0]), mask_code=Rle.of(mask(150, 200)), score=0.8)
    rows = fruit_rows([frame([true, replace(true, box=AWAY)], [fruit])], 0.3)
    hit, miss = rows.itertuples()
    # 80 of 120 pixels of the boxes' length are common, and half of the mask.
    assert (hit.found, hit.score) == (True, 0.8)
    assert hit.box_iou == pytest.approx(80 / 120)
    assert hit.mask_iou == 0.5
    assert (hit.long_px, hit.distance_m, hit.hidden_share, hit.cut_off) == (100, 0.6, 0.2, False)
    assert (miss.found, miss.fruit) == (False, 1)
    assert math.isnan(miss.mask_iou)


def test_what_becomes_of_a_detection() -> None:
    at_edge = np.array([-0.5, 300, 80, 340])
    true = [Label(BOX), Label(AWAY, ignore=True)]
    found = [
        Label(BOX, score=0.9, distance_m=0.5),
        Label(AWAY, score=0.8),
        Label(at_edge, score=0.7),
    ]
    rows = list(detection_rows([frame(true, found)], 0.3).itertuples())
    assert [row.outcome for row in rows] == ["hit", "neutral", "false"]
    assert [row.cut_off for row in rows] == [False, False, True]
    assert rows[0].distance_m == 0.5
    assert (rows[2].x1, rows[2].y2) == (-0.5, 340.0)


def test_distance_is_read_in_the_middle_of_the_box() -> None:
    depth = np.full((480, 640), 2.0, np.float32)
    depth[100:120, 133:167] = 0.7
    depth[110, 150] = 0.0
    assert detected_label(Instance(BOX), depth).distance_m == pytest.approx(0.7)
    assert math.isnan(detected_label(Instance(BOX)).distance_m)
    assert math.isnan(detected_label(Instance(BOX), np.zeros((480, 640), np.float32)).distance_m)


def posed(points: NDArray[np.float64]) -> list[Label]:
    return [Label(BOX, keypoints=points, score=0.9)]


def test_ends_are_judged_in_percent_of_the_line() -> None:
    points = LINE.copy()
    points[0, 0] -= 3.0
    points[4, :2] += (3.0, 4.0)
    true = LINE.copy()
    true[4, 2] = 1
    (row,) = end_rows([frame([Label(BOX, keypoints=true)], posed(points))], 0.3).itertuples()
    assert row.length_px == pytest.approx(100.0)
    assert (row.blossom_percent, row.stem_percent) == pytest.approx((3.0, 5.0))
    assert (row.blossom_seen, row.stem_seen, row.swapped) == (True, False, False)


def test_swapped_ends_are_judged_as_they_are() -> None:
    (row,) = end_rows([frame([Label(BOX, keypoints=LINE)], posed(LINE[::-1]))], 0.3).itertuples()
    assert (row.swapped, row.blossom_percent, row.stem_percent) == (True, 100.0, 100.0)


def test_an_end_outside_the_picture_is_not_judged() -> None:
    true = LINE.copy()
    true[4] = (700.0, 110.0, 0.0)  # known to be outside
    (row,) = end_rows([frame([Label(BOX, keypoints=true)], posed(LINE))], 0.3).itertuples()
    assert row.length_px == pytest.approx(600.0)
    assert math.isnan(row.stem_percent)
    assert (row.blossom_percent, row.swapped) == (0.0, None)
    true[4] = 0.0  # nobody knows where
    assert end_rows([frame([Label(BOX, keypoints=true)], posed(LINE))], 0.3).empty


def test_recall_and_precision_by_group() -> None:
    pictures = []
    for k in range(10):
        near = Label(BOX, hidden_share=0.0, cut_off=False, distance_m=0.4)
        far = Label(AWAY, hidden_share=0.4, cut_off=True, distance_m=1.0)
        found = [Label(BOX, score=0.9, distance_m=0.4)]
        # Every second far fruit is found; in every fifth picture a far leaf is taken for one.
        found += [Label(AWAY, score=0.8, distance_m=1.0)] if k % 2 else []
        stray = Label(BOX + np.array([300, 0, 300, 0]), score=0.5, distance_m=1.0)
        pictures.append(frame([near, far], found + ([stray] if k % 5 == 0 else []), f"{k}"))
    fruit, found_too = fruit_rows(pictures, 0.3), detection_rows(pictures, 0.3)
    whole = overall(fruit, found_too)
    assert (whole.recall.value, whole.recall.count) == (0.75, 20)
    assert whole.precision is not None
    assert (whole.precision.value, whole.precision.count) == (15 / 17, 17)
    scores = group_scores(fruit, found_too)
    groups = {(factor, group): score for factor, group, score in scores}
    assert groups["distance (m)", "under 0.45"].recall.value == 1.0
    far_off = groups["distance (m)", "0.9 or more"]
    assert far_off.recall.value == 0.5
    assert far_off.precision is not None
    assert far_off.precision.value == 5 / 7
    assert groups["hidden share (%)", "25 to 50"].recall.value == 0.5
    assert groups["hidden share (%)", "25 to 50"].precision is None
    assert groups["edge", "cut by the picture's edge"].recall.value == 0.5
    size = groups["longer side of the box (px)", "100 to 200"]
    assert (size.recall.count, size.recall.value) == (20, 0.75)
    assert size.recall.low < 0.75 < size.recall.high


FRUIT = [0.0, 0.0, 100.0, 20.0]


def shifted(by: float) -> list[float]:
    return [FRUIT[0] + by, 0.0, FRUIT[2] + by, 20.0]


@pytest.mark.parametrize(("by", "hit"), [(33.0, True), (34.0, False)])
def test_a_hit_overlaps_by_half(by: float, hit: bool) -> None:
    # Shifted by s of 100, the IoU is (100 - s) / (100 + s): 0.504 at 33 and 0.493 at 34.
    assert bool(match_boxes([shifted(by)], [FRUIT]).pairs) is hit


def test_optional_fruit_may_be_found_once() -> None:
    found = match_boxes([FRUIT, shifted(3)], [], optional=[FRUIT])
    assert (found.pairs, found.missed, found.neutral, found.false) == ((), (), (0,), (1,))


@pytest.mark.parametrize(("edge", "neutral"), [(50.0, True), (49.0, False)])
def test_half_of_a_detection_in_an_ignored_region(edge: float, neutral: bool) -> None:
    found = match_boxes([FRUIT], [], ignored=[[-500.0, -500.0, edge, 500.0]])
    assert (found.neutral == (0,)) is neutral
    assert (found.false == (0,)) is not neutral


SIZE = (200, 300)  # height, width


def rectangle(box: ArrayLike) -> NDArray[np.bool_]:
    x1, y1, x2, y2 = (round(float(v) + 0.5) for v in np.asarray(box))
    mask = np.zeros(SIZE, bool)
    mask[y1:y2, x1:x2] = True
    return mask


def edges(x: float, y: float, width: float = 100.0, height: float = 20.0) -> NDArray[np.float64]:
    """Give a box whose outermost pixels start at x, y."""
    return np.array([x, y, x + width, y + height]) - 0.5


def line(box: NDArray[np.float64], shift: float = 0.0) -> NDArray[np.float64]:
    u = np.linspace(box[0], box[2], 5)
    return np.column_stack([u, np.full(5, (box[1] + box[3]) / 2 + shift), np.full(5, 2.0)])


def true(box: NDArray[np.float64], *, ignore: bool = False) -> Label:
    return Label(box, mask_code=Rle.of(rectangle(box)), keypoints=line(box), ignore=ignore)


def seen(box: NDArray[np.float64], score: float, shift: float = 0.0) -> Label:
    return Label(box, mask_code=Rle.of(rectangle(box)), keypoints=line(box, shift), score=score)


def ranked_frame(fruit: list[Label], found: list[Label], name: str = "a", scene: str = "") -> Frame:
    best = tuple(sorted(found, key=lambda one: -one.score))
    return Frame(name, scene or name, SIZE[1], SIZE[0], tuple(fruit), best, best, best)


A, B, ELSEWHERE = edges(10, 10), edges(10, 100), edges(180, 150)


@pytest.mark.parametrize("iou_type", list(IouType))
def test_perfect_detections(iou_type: IouType) -> None:
    found = average_precision(
        [ranked_frame([true(A), true(B)], [seen(A, 0.9), seen(B, 0.2)])], iou_type
    )
    assert found.map50 == pytest.approx(1.0)
    assert found.map50_95 == pytest.approx(1.0)
    assert found.fruit == 2


@pytest.mark.parametrize("iou_type", list(IouType))
def test_a_false_one_between_two_hits(iou_type: IouType) -> None:
    found = average_precision(
        [ranked_frame([true(A), true(B)], [seen(A, 0.9), seen(ELSEWHERE, 0.8), seen(B, 0.7)])],
        iou_type,
    )
    # Precision is 1 up to a recall of 0.5 (51 of the 101 points) and 2/3 beyond.
    assert found.map50 == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert found.map50_95 == pytest.approx(found.map50)


def test_keypoint_similarity() -> None:
    # All five off by d: OKS = exp(-d² / (2 area (2 sigma)²)); 0.72 passes five thresholds of ten.
    area = 100 * 20
    d = math.sqrt(-math.log(0.72) * 2 * area * (2 * OKS_SIGMA) ** 2)
    found = average_precision([ranked_frame([true(A)], [seen(A, 0.9, shift=d)])], IouType.KEYPOINTS)
    assert found.map50_95 == pytest.approx(0.5)
    assert d == pytest.approx(3.62, abs=0.01)


@pytest.mark.parametrize("iou_type", [IouType.BOXES, IouType.MASKS])
def test_what_lies_in_an_ignored_region_counts_neither_way(iou_type: IouType) -> None:
    region = true(edges(170, 140, 120, 50), ignore=True)
    found = average_precision(
        [ranked_frame([true(A), region], [seen(ELSEWHERE, 0.95), seen(A, 0.9)])], iou_type
    )
    assert found.map50 == pytest.approx(1.0)
    assert found.fruit == 1


def test_fruit_without_mask_is_not_judged_by_masks() -> None:
    bare = Label(B)
    pictures = [ranked_frame([true(A), bare], [seen(A, 0.9), seen(B, 0.95)])]
    assert average_precision(pictures, IouType.MASKS).map50 == pytest.approx(1.0)
    assert average_precision(pictures, IouType.MASKS).fruit == 1
    assert average_precision(pictures, IouType.BOXES).fruit == 2
    assert average_precision(pictures, IouType.KEYPOINTS).fruit == 1


def test_nothing_to_find_has_no_figure() -> None:
    found = average_precision([ranked_frame([], [seen(A, 0.9)])], IouType.BOXES)
    assert math.isnan(found.map50)
    assert found.fruit == 0
