"""Match detections with labelled fruit: average precision by pycocotools, recall and precision."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from cucumbervision.accuracy.statistics import Estimate, share
from cucumbervision.fruit.masks import box_iou, box_ious, mask_iou, share_inside
from cucumbervision_lab.arrays import Array, Mask
from cucumbervision_lab.data.labels import DataSet, Label
from cucumbervision_lab.evaluate.pictures import (
    Frame,
    Networks,
    Stage,
    coco_code,
    import_pycocotools,
)

_MIN_IOU = 0.5

_IN_IGNORED = 0.5
"""Detections with at least this share inside ignore regions are neutral."""


@dataclass(frozen=True)
class Matches:
    """Matches between detections and labelled fruit of one picture.

    Parameters
    ----------
    pairs : tuple of (int, int)
        Indices of fruit and of their detections.
    missed : tuple of int
        Fruit without a detection (false negatives).
    false : tuple of int
        Detections without a fruit (false positives).
    neutral : tuple of int
        Detections of optional fruit or in ignore regions.
    """

    pairs: tuple[tuple[int, int], ...]
    missed: tuple[int, ...]
    false: tuple[int, ...]
    neutral: tuple[int, ...]


def match_boxes(
    found: ArrayLike, required: ArrayLike, optional: ArrayLike = (), ignored: ArrayLike = ()
) -> Matches:
    """Match detections greedily with labelled boxes in order of confidence, as in COCO.

    Parameters
    ----------
    found : array_like of float, shape (N, 4)
        Detections x1, y1, x2, y2, best first.
    required : array_like of float, shape (M, 4)
        Boxes of fruit to be detected.
    optional : array_like of float, shape (K, 4)
        Boxes of optional fruit, which may be detected once each.
    ignored : array_like of float, shape (L, 4)
        Ignore regions.

    Returns
    -------
    Matches
        Matches with an IoU of at least 0.5. An unmatched detection is neutral if at least half of
        its area lies in ignore regions, and otherwise false.

    Examples
    --------
    >>> boxes = [[0, 0, 10, 40], [1, 0, 11, 40], [50, 50, 60, 60], [90, 90, 99, 99]]
    >>> match_boxes(boxes, [[0, 0, 10, 40]], ignored=[[40, 40, 70, 70]])
    Matches(pairs=((0, 0),), missed=(), false=(1, 3), neutral=(2,))
    """
    boxes, needed, allowed = _boxes(found), _boxes(required), _boxes(optional)
    overlaps = box_ious(boxes, np.concatenate([needed, allowed]))
    inside = share_inside(boxes, _boxes(ignored))
    count, taken = len(needed), np.zeros(len(needed) + len(allowed), bool)
    pairs: list[tuple[int, int]] = []
    false: list[int] = []
    neutral: list[int] = []
    for k in range(len(boxes)):
        hit = _best(overlaps[k], taken, count)
        if hit is not None:
            taken[hit] = True
        if hit is not None and hit < count:
            pairs.append((hit, k))
        elif hit is not None or inside[k] >= _IN_IGNORED:
            neutral.append(k)
        else:
            false.append(k)
    missed = tuple(np.flatnonzero(~taken[:count]).tolist())
    return Matches(tuple(sorted(pairs)), missed, tuple(false), tuple(neutral))


def _best(overlaps: NDArray[Any], taken: Mask, required: int) -> int | None:
    """Return the unmatched box with the largest overlap, required boxes first."""
    free = np.where(taken, 0.0, overlaps)
    for part, start in ((free[:required], 0), (free[required:], required)):
        if part.size and part.max() >= _MIN_IOU:
            return start + int(part.argmax())
    return None


def _boxes(values: ArrayLike) -> Array:
    return np.asarray(values, np.float64).reshape(-1, 4)


_ENDS = [0, 4]  # blossom and stem

_EDGE_PX = 1.5  # a box closer to the border counts as cut off


def match_fruit(frame: Frame, boxes: Sequence[Array]) -> Matches:
    """Match boxes with the labelled fruit of a frame, numbered as in `frame.true`."""
    required = [k for k, fruit in enumerate(frame.true) if fruit.required]
    matches = match_boxes(
        boxes,
        [frame.true[k].box for k in required],
        optional=[fruit.box for fruit in frame.true if fruit.optional],
        ignored=[fruit.box for fruit in frame.true if fruit.ignore],
    )
    pairs = tuple((required[fruit], box) for fruit, box in matches.pairs)
    return replace(matches, pairs=pairs, missed=tuple(required[k] for k in matches.missed))


def match_detections(
    frame: Frame, confidence: float, stage: Stage
) -> tuple[Matches, tuple[Label, ...]]:
    """Match the detections of a frame above a confidence threshold; return these, too."""
    detections = tuple(s for s in frame.detections(stage) if s.score > confidence)
    return match_fruit(frame, [s.box for s in detections]), detections


_FRUIT = (
    *("picture", "scene", "fruit", "long_px", "distance_m", "hidden_share", "cut_off"),
    *("found", "score", "box_iou", "mask_iou"),
)
_DETECTION = (
    *("picture", "scene", "detection", "score", "long_px", "distance_m", "cut_off"),
    *("outcome", "x1", "y1", "x2", "y2"),
)
_END = (
    *("picture", "scene", "fruit", "length_px", "blossom_percent", "stem_percent"),
    *("blossom_seen", "stem_seen", "swapped", "blossom_score", "stem_score"),
)


def fruit_rows(
    frames: Sequence[Frame], confidence: float, stage: Stage = Stage.KEPT
) -> pd.DataFrame:
    """Return a row for every fruit to be detected.

    Columns: picture, scene, fruit (index among the picture's labels), long_px (longer side of the
    box), distance_m, hidden_share, cut_off, found; and of its detection score, box_iou, mask_iou.
    What is not known is NaN or None.
    """
    rows = []
    for frame in frames:
        matches, detections = match_detections(frame, confidence, stage)
        hit = {k: detections[s] for k, s in matches.pairs}
        for k, fruit in enumerate(frame.true):
            if not fruit.required:
                continue
            by = hit.get(k)
            hidden = math.nan if fruit.hidden_share is None else fruit.hidden_share
            place = fruit.long_px, fruit.distance_m, hidden, fruit.cut_off
            overlaps = (math.nan,) * 3
            if by is not None:
                true = fruit.mask if frame.has_masks else None
                of_masks = math.nan if true is None else mask_iou(by.mask, true)
                overlaps = by.score, box_iou(fruit.box, by.box), of_masks
            rows.append((frame.name, frame.scene, k, *place, by is not None, *overlaps))
    return pd.DataFrame(rows, columns=_FRUIT)


def detection_rows(
    frames: Sequence[Frame], confidence: float, stage: Stage = Stage.KEPT
) -> pd.DataFrame:
    """Return a row for every detection above a confidence threshold.

    Columns: picture, scene, detection (index, best first), score, long_px, distance_m (at the
    centre of the box), cut_off (by the picture's border), outcome ('hit', 'false' or 'neutral'),
    and the box x1, y1, x2, y2.
    """
    rows = []
    for frame in frames:
        matches, detections = match_detections(frame, confidence, stage)
        outcome = dict.fromkeys(range(len(detections)), "hit")
        outcome |= dict.fromkeys(matches.false, "false") | dict.fromkeys(matches.neutral, "neutral")
        for k, detection in enumerate(detections):
            place = detection.score, detection.long_px, detection.distance_m
            cut_off, box = _at_border(detection.box, frame), detection.box.tolist()
            rows.append((frame.name, frame.scene, k, *place, cut_off, outcome[k], *box))
    return pd.DataFrame(rows, columns=_DETECTION)


def end_rows(frames: Sequence[Frame], confidence: float) -> pd.DataFrame:
    """Return the errors of the ends used for measurement, a row a fruit.

    Includes every detected fruit with predicted keypoints whose five labelled keypoints have known
    positions. Swapped ends are not corrected, and ends outside the picture are NaN.

    Columns: picture, scene, fruit, length_px (of the line through the labelled keypoints),
    blossom_percent and stem_percent (distances of the ends, of that length), blossom_seen,
    stem_seen, swapped (None if an end lies outside the picture), blossom_score, stem_score.

    Examples
    --------
    >>> from cucumbervision_lab.data.labels import Label
    >>> from cucumbervision_lab.evaluate.pictures import Frame
    >>> true_points = np.array([[10.0, 10, 2], [35, 10, 2], [60, 10, 2], [85, 10, 2], [110, 10, 1]])
    >>> swapped = true_points[::-1] + (0, 1.0, 0)
    >>> box = np.array([10.0, 5, 110, 15])
    >>> detection = Label(box, keypoints=swapped, score=0.9)
    >>> truth = (Label(box, keypoints=true_points),)
    >>> frame = Frame("a", "a", 200, 50, truth, kept=(detection,))
    >>> row = end_rows([frame], 0.3).iloc[0]
    >>> float(row.length_px), round(float(row.blossom_percent), 3), bool(row.swapped)
    (100.0, 100.005, True)
    """
    rows = []
    for frame in frames:
        matches, detections = match_detections(frame, confidence, Stage.KEPT)
        for k, s in matches.pairs:
            true, points = frame.true[k].keypoints, detections[s].keypoints
            if true is None or points is None:
                continue
            # A position is known inside the picture and outside.
            if ((true[:, 2] > 0) | true[:, :2].any(axis=1)).all():
                rows.append((frame.name, frame.scene, k, *_end_errors(true, points)))
    return pd.DataFrame(rows, columns=_END)


def _end_errors(true: Array, points: Array) -> tuple[Any, ...]:
    length = float(np.linalg.norm(np.diff(true[:, :2], axis=0), axis=1).sum())
    ends, measured = true[_ENDS, :2], points[_ENDS, :2]
    straight = np.linalg.norm(measured - ends, axis=1)
    crossed = np.linalg.norm(measured[::-1] - ends, axis=1)
    labelled = true[_ENDS, 2] > 0
    percent = np.where(labelled, 100 * straight / max(length, 1e-9), math.nan)
    swapped = bool(crossed.sum() < straight.sum()) if labelled.all() else None
    return length, *percent, *(true[_ENDS, 2] == 2), swapped, *points[_ENDS, 2]


def _at_border(box: Array, frame: Frame) -> bool:
    inside = np.concatenate([box[:2] + 0.5, (frame.width - 0.5, frame.height - 0.5) - box[2:]])
    return bool(inside.min() < _EDGE_PX)


_SCALES: tuple[tuple[str, str, float, tuple[float, ...]], ...] = (
    ("distance (m)", "distance_m", 1.0, (0.0, 0.45, 0.6, 0.75, 0.9, math.inf)),
    ("longer side of the box (px)", "long_px", 1.0, (0, 50, 100, 200, 300, 450, math.inf)),
    ("hidden share (%)", "hidden_share", 100.0, (0.0, 0.01, 0.1, 0.25, 0.5, 0.75, 1.01)),
)


class Score(NamedTuple):
    """Recall of fruit; precision of detections, without neutral ones, or None where unknown."""

    recall: Estimate
    precision: Estimate | None


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A data set, and what the networks detected in it.

    Parameters
    ----------
    data : DataSet
        The evaluated pictures.
    networks : Networks
        The networks, with the confidence threshold for recall and precision.
    frames, small : tuple of Frame
        Labels and detections of each picture; of photos, also at half size.
    readings : DataFrame
        Lengths on true and on predicted masks, see `readings_frame`; may be empty.
    seconds : mapping of str to list of float
        Run time of each network for each picture.
    duration_s : float
        Total duration.
    missing : int
        Number of audited photos that are missing.
    """

    data: DataSet
    networks: Networks
    frames: tuple[Frame, ...]
    readings: pd.DataFrame = field(default_factory=pd.DataFrame)
    seconds: Mapping[str, Sequence[float]] = field(default_factory=dict)
    duration_s: float = 0.0
    small: tuple[Frame, ...] = ()
    missing: int = 0

    def score(self, *, small: bool = False, **extras: str) -> Score:
        """Compute recall and precision of all pictures, or of those with these `extras`."""
        pairs = zip(self.data.pictures, self.small if small else self.frames, strict=True)
        frames = [frame for photo, frame in pairs if extras.items() <= photo.extras.items()]
        threshold = self.networks.confidence
        return overall(fruit_rows(frames, threshold), detection_rows(frames, threshold))


def overall(fruit: pd.DataFrame, detections: pd.DataFrame | None) -> Score:
    """Compute recall and precision of fruit and detections."""
    recall = share(fruit["found"], fruit["scene"].tolist())
    if detections is None:
        return Score(recall, None)
    judged = detections[detections["outcome"] != "neutral"]
    return Score(recall, share(judged["outcome"] == "hit", judged["scene"].tolist()))


def group_scores(fruit: pd.DataFrame, detections: pd.DataFrame) -> Iterator[tuple[str, str, Score]]:
    """Compute recall and precision by distance, size, occluded share and `cut_off`.

    The occluded share of a false positive is unknown.

    Yields
    ------
    (str, str, Score)
        Property, group and score of each group that is not empty.
    """
    for factor, column, scale, edges in _SCALES:
        for start, end in pairwise(edges):
            inside = fruit[fruit[column].between(start, end, inclusive="left")]
            part = None
            if column in detections:
                part = detections[detections[column].between(start, end, inclusive="left")]
            if len(inside) or (part is not None and len(part)):
                yield factor, _name(start, end, scale), overall(inside, part)
    for name, cut in (("whole in the picture", False), ("cut by the picture's edge", True)):
        inside, part = (rows[rows["cut_off"] == cut] for rows in (fruit, detections))
        if len(inside) or len(part):
            yield "edge", name, overall(inside, part)


def _name(start: float, end: float, scale: float) -> str:
    if math.isinf(end) or (end > 1 and scale > 1):
        return f"{scale * start:g} or more"
    return f"under {scale * end:g}" if start == 0 else f"{scale * start:g} to {scale * end:g}"


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


class AveragePrecision(NamedTuple):
    """COCO average precision: number of labelled fruit, and NaN without any.

    `map50` is at an overlap of 0.5, `map50_95` the mean over 0.5, 0.55 … 0.95.
    """

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
        return AveragePrecision(0, math.nan, math.nan)
    precision = judge.eval["precision"]  # axes: overlap threshold, recall, ...
    return AveragePrecision(int(fruit), float(precision[0].mean()), float(precision.mean()))


def _annotations(
    frames: Sequence[Frame], iou_type: IouType, stage: Stage
) -> tuple[dict[str, Any], dict[str, Any]]:
    images = [{"id": k + 1, "width": f.width, "height": f.height} for k, f in enumerate(frames)]
    categories = [{"id": 1, "name": "cucumber"}]
    truth: list[dict[str, Any]] = []
    detections: list[dict[str, Any]] = []
    for k, frame in enumerate(frames):
        truth += [
            _entry(fruit, iou_type, frame, is_true=True) | {"image_id": k + 1}
            for fruit in frame.true
        ]
        # A detection without a mask counts as a false positive.
        detections += [
            _entry(detection, iou_type, frame) | {"image_id": k + 1}
            for detection in frame.detections(stage)
            if iou_type is not IouType.KEYPOINTS or detection.keypoints is not None
        ]
    for entries in (truth, detections):
        for number, entry in enumerate(entries):
            entry |= {"id": number + 1, "category_id": 1}
    head = {"images": images, "categories": categories}
    return {**head, "annotations": truth}, {**head, "annotations": detections}


def _entry(
    label: Label, iou_type: IouType, frame: Frame, *, is_true: bool = False
) -> dict[str, Any]:
    masks = import_pycocotools()
    x1, y1, x2, y2 = (float(edge) + 0.5 for edge in label.box)
    box = [x1, y1, x2 - x1, y2 - y1]
    points = np.zeros((5, 3)) if label.keypoints is None else label.keypoints
    labelled = int(np.count_nonzero(points[:, 2] > 0))
    code = None if label.mask_code is None else coco_code(label.mask_code)
    unknown = {IouType.MASKS: code is None, IouType.KEYPOINTS: not labelled}.get(iou_type, False)
    entry: dict[str, Any] = {
        "bbox": box,
        "area": float(masks.area(code)) if code else _BOX_FILL * box[2] * box[3],
        "iscrowd": int(is_true and (unknown or not label.required)),
        "score": label.score,
        "keypoints": (points + _TO_CORNER).ravel().tolist(),
        "num_keypoints": labelled,
    }
    if iou_type is IouType.MASKS:
        empty = {"size": [frame.height, frame.width], "counts": [frame.height * frame.width]}
        filled = masks.frPyObjects(np.array([box]), frame.height, frame.width)[0]
        entry["segmentation"] = code or (filled if is_true else empty)
    return entry
