"""Match detections with labelled fruit, and compute recall and precision by group."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.accuracy.statistics import Estimate, share
from cucumbervision.instances.boxes import box_iou, box_ious, share_inside
from cucumbervision_lab.detection.pictures import Stage, code_iou

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from cucumbervision_lab.detection.pictures import DetectedFruit, Frame

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
    found: ArrayLike,
    required: ArrayLike,
    optional: ArrayLike = (),
    ignored: ArrayLike = (),
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


def _best(overlaps: NDArray[Any], taken: NDArray[np.bool_], required: int) -> int | None:
    """Return the unmatched box with the largest overlap, required boxes first."""
    free = np.where(taken, 0.0, overlaps)
    for part, start in ((free[:required], 0), (free[required:], required)):
        if part.size and part.max() >= _MIN_IOU:
            return start + int(part.argmax())
    return None


def _boxes(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, np.float64).reshape(-1, 4)


_BLOSSOM, STEM = 0, 4

_EDGE_PX = 1.5  # a box closer to the border counts as cut off


@dataclass(frozen=True)
class FruitRow:
    """Outcome of one labelled fruit.

    Parameters
    ----------
    picture, scene : str
        Picture and scene.
    fruit : int
        Index among the picture's labels.
    long_px : float
        Longer side of the box, pixels.
    distance_m, hidden_share : float
        Distance and occluded share of the fruit; NaN if unknown.
    cut_off : bool, optional
        Whether the fruit extends beyond the picture.
    found : bool
        Whether the fruit was detected.
    score, box_iou, mask_iou : float
        Confidence and overlaps of its detection; NaN if missed (`mask_iou` also without masks).
    """

    picture: str
    scene: str
    fruit: int
    long_px: float
    distance_m: float
    hidden_share: float
    cut_off: bool | None
    found: bool
    score: float = math.nan
    box_iou: float = math.nan
    mask_iou: float = math.nan


@dataclass(frozen=True)
class DetectionRow:
    """Outcome of one detection.

    Parameters
    ----------
    picture, scene : str
        Picture and scene.
    detection : int
        Index among the picture's detections, best first.
    score : float
        Confidence.
    long_px : float
        Longer side of the box, pixels.
    distance_m : float
        Distance at the centre of the box; NaN if unknown.
    cut_off : bool
        Whether the box touches the picture's border.
    outcome : str
        'hit', 'false' or 'neutral'.
    x1, y1, x2, y2 : float
        Box, pixels.
    """

    picture: str
    scene: str
    detection: int
    score: float
    long_px: float
    distance_m: float
    cut_off: bool
    outcome: str
    x1: float
    y1: float
    x2: float
    y2: float


@dataclass(frozen=True)
class EndRow:
    """Errors of both ends of one fruit.

    Parameters
    ----------
    picture, scene : str
        Picture and scene.
    fruit : int
        Index among the picture's labels.
    length_px : float
        Length of the polyline through the five labelled keypoints, pixels.
    blossom_percent, stem_percent : float
        Distance between labelled and predicted end, percent of that length; NaN for an end
        outside the picture.
    blossom_seen, stem_seen : bool
        Whether the end is visible.
    swapped : bool, optional
        Whether the predicted ends are swapped; None if an end lies outside the picture.
    blossom_score, stem_score : float
        Predicted visibility, 0 to 1.
    """

    picture: str
    scene: str
    fruit: int
    length_px: float
    blossom_percent: float
    stem_percent: float
    blossom_seen: bool
    stem_seen: bool
    swapped: bool | None
    blossom_score: float
    stem_score: float


def match_fruit(
    frame: Frame, boxes: Sequence[NDArray[np.float64]]
) -> tuple[Matches, tuple[int, ...]]:
    """Match boxes with the labelled fruit of a frame.

    Returns
    -------
    matches : Matches
        Pairs of indices into `required` and into `boxes`.
    required : tuple of int
        Indices in `frame.true` of the fruit to be detected.
    """
    required = tuple(k for k, fruit in enumerate(frame.true) if fruit.required)
    matches = match_boxes(
        boxes,
        [frame.true[k].box for k in required],
        optional=[fruit.box for fruit in frame.true if fruit.optional],
        ignored=[fruit.box for fruit in frame.true if fruit.ignore],
    )
    return matches, required


def match_detections(
    frame: Frame, confidence: float, stage: Stage
) -> tuple[Matches, tuple[DetectedFruit, ...], tuple[int, ...]]:
    """Match the detections of a frame above a confidence threshold.

    Returns
    -------
    matches : Matches
        Pairs of indices into `required` and into `seen`.
    detections : tuple of DetectedFruit
        Detections above the threshold.
    required : tuple of int
        Indices in `frame.true` of the fruit to be detected.
    """
    detections = tuple(s for s in frame.detections(stage) if s.score > confidence)
    matches, required = match_fruit(frame, [s.box for s in detections])
    return matches, detections, required


def fruit_rows(
    frames: Sequence[Frame], confidence: float, stage: Stage = Stage.KEPT
) -> list[FruitRow]:
    """Return the outcome of every fruit to be detected."""
    rows = []
    for frame in frames:
        matches, detections, required = match_detections(frame, confidence, stage)
        hit = {required[t]: detections[s] for t, s in matches.pairs}
        for k in required:
            fruit, by = frame.true[k], hit.get(k)
            rows.append(
                FruitRow(
                    frame.name,
                    frame.scene,
                    k,
                    fruit.long_px,
                    fruit.distance_m,
                    fruit.hidden_share,
                    fruit.cut_off,
                    by is not None,
                    *(() if by is None else _overlaps(frame, k, by)),
                )
            )
    return rows


def _overlaps(frame: Frame, number: int, by: DetectedFruit) -> tuple[float, float, float]:
    fruit = frame.true[number]
    masks = frame.has_masks and fruit.code is not None
    of_masks = code_iou(fruit.code, by.code) if masks else math.nan
    return by.score, box_iou(fruit.box, by.box), of_masks


def detection_rows(
    frames: Sequence[Frame], confidence: float, stage: Stage = Stage.KEPT
) -> list[DetectionRow]:
    """Return the outcome of every detection above a confidence threshold."""
    rows = []
    for frame in frames:
        matches, detections, _ = match_detections(frame, confidence, stage)
        outcome = dict.fromkeys(range(len(detections)), "hit")
        outcome |= dict.fromkeys(matches.false, "false") | dict.fromkeys(matches.neutral, "neutral")
        for k, detection in enumerate(detections):
            edges = [float(x) for x in detection.box]
            rows.append(
                DetectionRow(
                    frame.name,
                    frame.scene,
                    k,
                    detection.score,
                    detection.long_px,
                    detection.distance_m,
                    _at_border(detection.box, frame),
                    outcome[k],
                    *edges,
                )
            )
    return rows


def end_rows(frames: Sequence[Frame], confidence: float) -> list[EndRow]:
    """Compute the errors of the ends used for measurement.

    Includes every detected fruit with predicted keypoints whose five labelled keypoints have known
    positions. Swapped ends are not corrected, and ends outside the picture are skipped.

    Examples
    --------
    >>> from cucumbervision_lab.detection.pictures import Frame, DetectedFruit, TrueFruit
    >>> true_points = np.array([[10.0, 10, 2], [35, 10, 2], [60, 10, 2], [85, 10, 2], [110, 10, 1]])
    >>> swapped = true_points[::-1] + (0, 1.0, 0)
    >>> box = np.array([10.0, 5, 110, 15])
    >>> detection = DetectedFruit(box, 0.9, None, swapped)
    >>> truth = (TrueFruit(box, keypoints=true_points),)
    >>> frame = Frame("a", "a", 200, 50, truth, kept=(detection,))
    >>> row, = end_rows([frame], 0.3)
    >>> row.length_px, round(row.blossom_percent, 3), row.swapped, row.stem_seen
    (100.0, 100.005, True, False)
    """
    rows = []
    for frame in frames:
        matches, detections, required = match_detections(frame, confidence, Stage.KEPT)
        for t, s in matches.pairs:
            true_points, points = frame.true[required[t]].keypoints, detections[s].keypoints
            if true_points is None or points is None or not _placed(true_points):
                continue
            rows.append(_ends(frame, required[t], true_points, points))
    return rows


def _placed(keypoints: NDArray[np.float64]) -> bool:
    """Return whether all keypoints have a known position, inside the picture or outside."""
    return bool(((keypoints[:, 2] > 0) | keypoints[:, :2].any(axis=1)).all())


def _ends(
    frame: Frame, number: int, true_points: NDArray[np.float64], points: NDArray[np.float64]
) -> EndRow:
    length = float(np.linalg.norm(np.diff(true_points[:, :2], axis=0), axis=1).sum())
    ends, points_px = true_points[[_BLOSSOM, STEM], :2], points[[_BLOSSOM, STEM], :2]
    straight = np.linalg.norm(points_px - ends, axis=1)
    crossed = np.linalg.norm(points_px[::-1] - ends, axis=1)
    labelled = true_points[[_BLOSSOM, STEM], 2] > 0
    percent = np.where(labelled, 100 * straight / max(length, 1e-9), math.nan)
    return EndRow(
        frame.name,
        frame.scene,
        number,
        length,
        float(percent[0]),
        float(percent[1]),
        bool(true_points[_BLOSSOM, 2] == 2),
        bool(true_points[STEM, 2] == 2),
        bool(crossed.sum() < straight.sum()) if labelled.all() else None,
        float(points[_BLOSSOM, 2]),
        float(points[STEM, 2]),
    )


def _at_border(box: NDArray[np.float64], frame: Frame) -> bool:
    inside = np.concatenate([box[:2] + 0.5, (frame.width - 0.5, frame.height - 0.5) - box[2:]])
    return bool(inside.min() < _EDGE_PX)


_DISTANCE_M = (0.0, 0.45, 0.6, 0.75, 0.9, math.inf)

_LONG_PX = (0.0, 50.0, 100.0, 200.0, 300.0, 450.0, math.inf)


_HIDDEN = (0.0, 0.01, 0.1, 0.25, 0.5, 0.75, 1.01)


@dataclass(frozen=True)
class GroupScore:
    """Recall and precision of one group.

    Parameters
    ----------
    factor, group : str
        Property for grouping, and the group.
    recall : Estimate
        Recall of the fruit in this group.
    precision : Estimate, optional
        Precision of the detections in this group, without neutral ones; None if the property is
        unknown for false positives.
    """

    factor: str
    group: str
    recall: Estimate
    precision: Estimate | None


def overall(fruit: Sequence[FruitRow], detections: Sequence[DetectionRow]) -> GroupScore:
    """Compute recall and precision of all fruit and detections."""
    return GroupScore("all", "all", _recall(fruit), _precision(detections))


def group_scores(fruit: Sequence[FruitRow], detections: Sequence[DetectionRow]) -> list[GroupScore]:
    """Compute recall and precision by group.

    Parameters
    ----------
    fruit : sequence of FruitRow
        Fruit for recall, grouped by distance, size, occluded share and `cut_off`.
    detections : sequence of DetectionRow
        Detections for precision, grouped by distance, size and `cut_off`; the occluded share of a
        false positive is unknown.

    Returns
    -------
    list of GroupScore
        Scores of all groups that are not empty.
    """
    scores = _by_scale("distance (m)", "distance_m", _DISTANCE_M, fruit, detections)
    scores += _by_scale("longer side of the box (px)", "long_px", _LONG_PX, fruit, detections)
    scores += _by_scale("hidden share (%)", "hidden_share", _HIDDEN, fruit, None)
    for name, cut in (("whole in the picture", False), ("cut by the picture's edge", True)):
        cut_fruit = [r for r in fruit if r.cut_off is cut]
        cut_detections = [r for r in detections if r.cut_off is cut]
        if cut_fruit or cut_detections:
            scores.append(GroupScore("edge", name, _recall(cut_fruit), _precision(cut_detections)))
    return scores


def _by_scale(
    factor: str,
    field: str,
    edges: Sequence[float],
    fruit: Sequence[FruitRow],
    detections: Sequence[DetectionRow] | None,
) -> list[GroupScore]:
    """Compute recall and, if `detections` are given, precision in the intervals between `edges`."""
    scores = []
    for start, end in pairwise(edges):
        fruit_inside = [r for r in fruit if start <= getattr(r, field) < end]
        detections_inside = [r for r in detections or () if start <= getattr(r, field) < end]
        if fruit_inside or detections_inside:
            precision = None if detections is None else _precision(detections_inside)
            name = _name(start, end, 100.0 if detections is None else 1.0)
            scores.append(GroupScore(factor, name, _recall(fruit_inside), precision))
    return scores


def _name(start: float, end: float, scale: float) -> str:
    if math.isinf(end) or (end > 1 and scale > 1):
        return f"{scale * start:g} or more"
    return f"under {scale * end:g}" if start == 0 else f"{scale * start:g} to {scale * end:g}"


def _recall(rows: Sequence[FruitRow]) -> Estimate:
    return share([r.found for r in rows], [r.scene for r in rows])


def _precision(rows: Sequence[DetectionRow]) -> Estimate:
    judged = [r for r in rows if r.outcome != "neutral"]
    return share([r.outcome == "hit" for r in judged], [r.scene for r in judged])
