"""Average precision of detections whose curves can be drawn by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

pytest.importorskip("pycocotools")

from cucumbervision.fruit.mask_codes import Rle
from cucumbervision_lab.data.labels import Label
from cucumbervision_lab.evaluate.outcomes import OKS_SIGMA, IouType, average_precision
from cucumbervision_lab.evaluate.pictures import Frame

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


def frame(fruit: list[Label], found: list[Label], name: str = "a", scene: str = "") -> Frame:
    best = tuple(sorted(found, key=lambda one: -one.score))
    return Frame(name, scene or name, SIZE[1], SIZE[0], tuple(fruit), best, best, best)


A, B, ELSEWHERE = edges(10, 10), edges(10, 100), edges(180, 150)


@pytest.mark.parametrize("iou_type", list(IouType))
def test_perfect_detections(iou_type: IouType) -> None:
    found = average_precision([frame([true(A), true(B)], [seen(A, 0.9), seen(B, 0.2)])], iou_type)
    assert found.map50 == pytest.approx(1.0)
    assert found.map50_95 == pytest.approx(1.0)
    assert found.fruit == 2


@pytest.mark.parametrize("iou_type", list(IouType))
def test_a_false_one_between_two_hits(iou_type: IouType) -> None:
    found = average_precision(
        [frame([true(A), true(B)], [seen(A, 0.9), seen(ELSEWHERE, 0.8), seen(B, 0.7)])], iou_type
    )
    # Precision is 1 up to a recall of 0.5 (51 of the 101 points) and 2/3 beyond.
    assert found.map50 == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert found.map50_95 == pytest.approx(found.map50)


def test_keypoint_similarity() -> None:
    # All five off by d: OKS = exp(-d² / (2 area (2 sigma)²)); 0.72 passes five thresholds of ten.
    area = 100 * 20
    d = math.sqrt(-math.log(0.72) * 2 * area * (2 * OKS_SIGMA) ** 2)
    found = average_precision([frame([true(A)], [seen(A, 0.9, shift=d)])], IouType.KEYPOINTS)
    assert found.map50_95 == pytest.approx(0.5)
    assert d == pytest.approx(3.62, abs=0.01)


@pytest.mark.parametrize("iou_type", [IouType.BOXES, IouType.MASKS])
def test_what_lies_in_an_ignored_region_counts_neither_way(iou_type: IouType) -> None:
    region = true(edges(170, 140, 120, 50), ignore=True)
    found = average_precision(
        [frame([true(A), region], [seen(ELSEWHERE, 0.95), seen(A, 0.9)])], iou_type
    )
    assert found.map50 == pytest.approx(1.0)
    assert found.fruit == 1


def test_fruit_without_mask_is_not_judged_by_masks() -> None:
    bare = Label(B)
    pictures = [frame([true(A), bare], [seen(A, 0.9), seen(B, 0.95)])]
    assert average_precision(pictures, IouType.MASKS).map50 == pytest.approx(1.0)
    assert average_precision(pictures, IouType.MASKS).fruit == 1
    assert average_precision(pictures, IouType.BOXES).fruit == 2
    assert average_precision(pictures, IouType.KEYPOINTS).fruit == 1


def test_nothing_to_find_has_no_figure() -> None:
    found = average_precision([frame([], [seen(A, 0.9)])], IouType.BOXES)
    assert math.isnan(found.map50)
    assert found.fruit == 0
