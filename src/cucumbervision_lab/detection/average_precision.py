"""Average precision by pycocotools, with an interval by scene."""

from __future__ import annotations

import contextlib
import io
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.accuracy.statistics import Estimate, resample_weights
from cucumbervision_lab.detection.pictures import Stage, import_pycocotools

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision_lab.detection.pictures import FoundFruit, Frame, TrueFruit

OKS_SIGMA = 0.05
"""For all five keypoints; the default for five points, 0.2, would forgive almost anything."""

_MAX_FOUND = 100  # a picture, as COCO
_BOX_FILL = 0.53  # mask over box, as Ultralytics takes it where there is no mask
_RESAMPLES = 300
_TO_CORNER = np.array([0.5, 0.5, 0.0])  # COCO counts pixels from the corner


class Judged(StrEnum):
    """What is compared with the truth."""

    BOXES = "bbox"
    MASKS = "segm"
    KEYPOINTS = "keypoints"


@dataclass(frozen=True)
class AveragePrecision:
    """COCO's two figures of one network's boxes, masks or keypoints.

    Parameters
    ----------
    stage, judged : Stage, Judged
        Whose detections, and what of them was compared.
    map50 : Estimate
        Average precision where a hit needs an IoU (keypoints: an OKS) of 0.50.
    map50_95 : Estimate
        Its mean over 0.50, 0.55 … 0.95.
    """

    stage: Stage
    judged: Judged
    map50: Estimate
    map50_95: Estimate


def average_precision(
    frames: Sequence[Frame], judged: Judged, stage: Stage = Stage.SEGMENTED
) -> AveragePrecision:
    """Compute average precision as COCO does.

    Regions to be ignored, and optional fruit, are COCO's crowds: a detection that lies in one by
    enough of its own area counts neither way. A fruit without a mask (or keypoints) becomes such a
    region where masks (or keypoints) are judged. The scale of the object keypoint similarity is
    the area of the visible mask, as COCO's; without a mask 0.53 of the box.

    Parameters
    ----------
    frames : sequence of Frame
        With detections down to a very low confidence.
    judged : Judged
        What is compared.
    stage : Stage
        Whose detections.

    Returns
    -------
    AveragePrecision
        The values are pycocotools'; the intervals draw scenes anew. NaN where there is nothing
        to judge.

    Raises
    ------
    MissingExtraError
        If pycocotools is not installed.
    """
    tally = _tally(frames, judged, stage)
    kept = [f.scene for f in frames]
    scenes = {name: k for k, name in enumerate(dict.fromkeys(kept))}
    count = int(tally.required.sum())
    if not count:
        nothing = Estimate(math.nan, math.nan, math.nan, 0, 0)
        return AveragePrecision(stage, judged, nothing, nothing)
    of_frame = np.array([scenes[name] for name in kept])
    drawn = np.array(
        [_precisions(tally, w[of_frame]) for w in resample_weights(len(scenes), _RESAMPLES)]
    )
    values = _precisions(tally, np.ones(len(frames)))
    with_fruit = len(set(of_frame[tally.required > 0].tolist()))

    def one(value: float, resampled: NDArray[np.float64]) -> Estimate:
        low = high = math.nan
        if len(scenes) > 1:
            low, high = np.nanpercentile(resampled, [2.5, 97.5])
        return Estimate(float(value), float(low), float(high), count, with_fruit)

    map50, map50_95 = one(values[0], drawn[:, 0]), one(values.mean(), drawn.mean(axis=1))
    return AveragePrecision(stage, judged, map50, map50_95)


@dataclass(frozen=True, eq=False)
class _Tally:
    """Every judged detection of the set, best first, by threshold (T = 10)."""

    frame: NDArray[np.intp]  # (N,)
    right: NDArray[np.bool_]  # (T, N)
    wrong: NDArray[np.bool_]  # (T, N)
    required: NDArray[np.int64]  # true fruit of each frame
    recalls: NDArray[np.float64]  # at which precision is read off


def _tally(frames: Sequence[Frame], judged: Judged, stage: Stage) -> _Tally:
    import_pycocotools()
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    truth, found = _annotations(frames, judged, stage)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its progress
        known, seen = COCO(), COCO()
        known.dataset, seen.dataset = truth, found
        known.createIndex()
        seen.createIndex()
        judge = COCOeval(known, seen, str(judged))
        judge.params.maxDets = [_MAX_FOUND]
        judge.params.areaRng, judge.params.areaRngLbl = [[0, 1e10]], ["all"]
        if judged is Judged.KEYPOINTS:
            judge.params.kpt_oks_sigmas = np.full(5, OKS_SIGMA)
        judge.evaluate()
    parts = [(k, e) for k, e in enumerate(judge.evalImgs) if e is not None]
    required = np.zeros(len(frames), np.int64)
    for k, e in parts:
        required[k] = np.count_nonzero(np.asarray(e["gtIgnore"]) == 0)
    scores = np.concatenate([np.asarray(e["dtScores"], float) for _, e in parts] or [np.zeros(0)])
    order = np.argsort(-scores, kind="mergesort")
    rows = len(judge.params.iouThrs)
    hit = np.concatenate([e["dtMatches"] > 0 for _, e in parts] or [np.zeros((rows, 0), bool)], 1)
    aside = np.concatenate([e["dtIgnore"] for _, e in parts] or [np.zeros((rows, 0), bool)], 1)
    aside = aside.astype(bool)
    where = np.concatenate([np.full(len(e["dtScores"]), k) for k, e in parts] or [np.zeros(0)])
    return _Tally(
        where.astype(np.intp)[order],
        (hit & ~aside)[:, order],
        (~hit & ~aside)[:, order],
        required,
        np.asarray(judge.params.recThrs, float),
    )


def _precisions(tally: _Tally, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the average precision at each threshold, shape (T,), each frame counted so often.

    The interpolation is COCO's (`COCOeval.accumulate`): precision made monotone, read off at 101
    recalls.
    """
    required = float(weights @ tally.required)
    if not required:
        return np.full(len(tally.right), np.nan)
    counted = weights[tally.frame]
    kept = counted > 0
    counted = counted[kept]
    out = np.zeros(len(tally.right))
    for t, (right, wrong) in enumerate(zip(tally.right, tally.wrong, strict=True)):
        hits = np.cumsum(counted * right[kept])
        recall = hits / required
        precision = hits / (np.cumsum(counted * wrong[kept]) + hits + np.spacing(1))
        best = np.maximum.accumulate(precision[::-1])[::-1]
        # Past the last recall that is reached precision is 0.
        out[t] = np.append(best, 0.0)[np.searchsorted(recall, tally.recalls)].mean()
    return out


def _annotations(
    frames: Sequence[Frame], judged: Judged, stage: Stage
) -> tuple[dict[str, Any], dict[str, Any]]:
    images = [{"id": k + 1, "width": f.width, "height": f.height} for k, f in enumerate(frames)]
    categories = [{"id": 1, "name": "cucumber"}]
    truth: list[dict[str, Any]] = []
    found: list[dict[str, Any]] = []
    for k, frame in enumerate(frames):
        truth += [_true_entry(one, judged, frame) | {"image_id": k + 1} for one in frame.true]
        # A detection without a mask is judged, and hits nothing.
        found += [
            _seen_entry(one, judged, frame) | {"image_id": k + 1}
            for one in frame.seen(stage)
            if judged is not Judged.KEYPOINTS or one.keypoints is not None
        ]
    for entries in (truth, found):
        for number, entry in enumerate(entries):
            entry |= {"id": number + 1, "category_id": 1}
    head = {"images": images, "categories": categories}
    return {**head, "annotations": truth}, {**head, "annotations": found}


def _true_entry(one: TrueFruit, judged: Judged, frame: Frame) -> dict[str, Any]:
    masks = import_pycocotools()
    box = _xywh(one.box)
    points = np.zeros((5, 3)) if one.keypoints is None else one.keypoints
    unlabelled = judged is Judged.KEYPOINTS and not (points[:, 2] > 0).any()
    unknown = unlabelled or (judged is Judged.MASKS and one.code is None)
    area = float(masks.area(one.code)) if one.code else _BOX_FILL * box[2] * box[3]
    entry: dict[str, Any] = {"bbox": box, "area": area, "iscrowd": int(unknown or not one.required)}
    if judged is Judged.MASKS:
        filled = masks.frPyObjects(np.array([box]), frame.height, frame.width)[0]
        entry["segmentation"] = one.code or filled
    if judged is Judged.KEYPOINTS:
        points = np.zeros((5, 3)) if unlabelled else points + _TO_CORNER
        entry["keypoints"] = points.ravel().tolist()
        entry["num_keypoints"] = int(np.count_nonzero(points[:, 2] > 0))
    return entry


def _seen_entry(one: FoundFruit, judged: Judged, frame: Frame) -> dict[str, Any]:
    box = _xywh(one.box)
    entry: dict[str, Any] = {"bbox": box, "area": box[2] * box[3], "score": one.score}
    if judged is Judged.MASKS:
        empty = {"size": [frame.height, frame.width], "counts": [frame.height * frame.width]}
        entry["segmentation"] = one.code or empty
    if judged is Judged.KEYPOINTS and one.keypoints is not None:
        entry["keypoints"] = (one.keypoints + _TO_CORNER).ravel().tolist()
    return entry


def _xywh(box: NDArray[np.float64]) -> list[float]:
    x1, y1, x2, y2 = (float(edge) + 0.5 for edge in box)
    return [x1, y1, x2 - x1, y2 - y1]
