"""Average precision by pycocotools."""

from __future__ import annotations

import contextlib
import io
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision_lab.detection.pictures import Stage, import_pycocotools

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision_lab.detection.pictures import DetectedFruit, Frame, TrueFruit

OKS_SIGMA = 0.05
"""OKS sigma of all five keypoints; the default of 0.2 for five points is far too tolerant."""

_MAX_DETECTIONS = 100  # per picture, as in COCO
_BOX_FILL = 0.53  # ratio of mask to box area that Ultralytics assumes without a mask
_TO_CORNER = np.array([0.5, 0.5, 0.0])  # the origin of COCO is the picture's corner


class IouType(StrEnum):
    """COCO's kinds of overlap."""

    BOXES = "bbox"
    MASKS = "segm"
    KEYPOINTS = "keypoints"


@dataclass(frozen=True)
class AveragePrecision:
    """COCO average precision of one stage.

    Parameters
    ----------
    stage : Stage
        Stage whose detections are evaluated.
    iou_type : IouType
        Boxes, masks or keypoints.
    fruit : int
        Number of labelled fruit.
    map50, map50_95 : float
        At an overlap of 0.5, and the mean over 0.5, 0.55 … 0.95; NaN without labelled fruit.
    """

    stage: Stage
    iou_type: IouType
    fruit: int
    map50: float
    map50_95: float


def average_precision(
    frames: Sequence[Frame], iou_type: IouType, stage: Stage = Stage.SEGMENTED
) -> AveragePrecision:
    """Compute average precision with pycocotools.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled pictures with detections, at least one.
    iou_type : IouType
        Kind of overlap.
    stage : Stage
        Stage whose detections are evaluated.

    Raises
    ------
    MissingExtraError
        If pycocotools is not installed.
    """
    import_pycocotools()
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    truth_coco, detection_coco = COCO(), COCO()
    truth_coco.dataset, detection_coco.dataset = _annotations(frames, iou_type, stage)
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        truth_coco.createIndex()
        detection_coco.createIndex()
        judge = COCOeval(truth_coco, detection_coco, str(iou_type))
        judge.params.maxDets = [_MAX_DETECTIONS]
        judge.params.areaRng, judge.params.areaRngLbl = [[0, 1e10]], ["all"]
        if iou_type is IouType.KEYPOINTS:
            judge.params.kpt_oks_sigmas = np.full(5, OKS_SIGMA)
        judge.evaluate()
        judge.accumulate()
    fruit = sum(np.count_nonzero(np.asarray(e["gtIgnore"]) == 0) for e in judge.evalImgs if e)
    if not fruit:
        return AveragePrecision(stage, iou_type, 0, math.nan, math.nan)
    precision = judge.eval["precision"]  # axes: overlap threshold, recall, ...
    return AveragePrecision(
        stage, iou_type, int(fruit), float(precision[0].mean()), float(precision.mean())
    )


def _annotations(
    frames: Sequence[Frame], iou_type: IouType, stage: Stage
) -> tuple[dict[str, Any], dict[str, Any]]:
    images = [{"id": k + 1, "width": f.width, "height": f.height} for k, f in enumerate(frames)]
    categories = [{"id": 1, "name": "cucumber"}]
    truth: list[dict[str, Any]] = []
    detections: list[dict[str, Any]] = []
    for k, frame in enumerate(frames):
        truth += [_true_entry(fruit, iou_type, frame) | {"image_id": k + 1} for fruit in frame.true]
        # A detection without a mask counts as a false positive.
        detections += [
            _seen_entry(detection, iou_type, frame) | {"image_id": k + 1}
            for detection in frame.detections(stage)
            if iou_type is not IouType.KEYPOINTS or detection.keypoints is not None
        ]
    for entries in (truth, detections):
        for number, entry in enumerate(entries):
            entry |= {"id": number + 1, "category_id": 1}
    head = {"images": images, "categories": categories}
    return {**head, "annotations": truth}, {**head, "annotations": detections}


def _true_entry(fruit: TrueFruit, iou_type: IouType, frame: Frame) -> dict[str, Any]:
    masks = import_pycocotools()
    box = _xywh(fruit.box)
    points = np.zeros((5, 3)) if fruit.keypoints is None else fruit.keypoints
    unlabelled = iou_type is IouType.KEYPOINTS and not (points[:, 2] > 0).any()
    unknown = unlabelled or (iou_type is IouType.MASKS and fruit.code is None)
    area = float(masks.area(fruit.code)) if fruit.code else _BOX_FILL * box[2] * box[3]
    entry: dict[str, Any] = {
        "bbox": box,
        "area": area,
        "iscrowd": int(unknown or not fruit.required),
    }
    if iou_type is IouType.MASKS:
        filled = masks.frPyObjects(np.array([box]), frame.height, frame.width)[0]
        entry["segmentation"] = fruit.code or filled
    if iou_type is IouType.KEYPOINTS:
        points = np.zeros((5, 3)) if unlabelled else points + _TO_CORNER
        entry["keypoints"] = points.ravel().tolist()
        entry["num_keypoints"] = int(np.count_nonzero(points[:, 2] > 0))
    return entry


def _seen_entry(detection: DetectedFruit, iou_type: IouType, frame: Frame) -> dict[str, Any]:
    box = _xywh(detection.box)
    entry: dict[str, Any] = {"bbox": box, "area": box[2] * box[3], "score": detection.score}
    if iou_type is IouType.MASKS:
        empty = {"size": [frame.height, frame.width], "counts": [frame.height * frame.width]}
        entry["segmentation"] = detection.code or empty
    if iou_type is IouType.KEYPOINTS and detection.keypoints is not None:
        entry["keypoints"] = (detection.keypoints + _TO_CORNER).ravel().tolist()
    return entry


def _xywh(box: NDArray[np.float64]) -> list[float]:
    x1, y1, x2, y2 = (float(edge) + 0.5 for edge in box)
    return [x1, y1, x2 - x1, y2 - y1]
