"""Decode the heads of YOLO networks: rows of box, score, class and extras from the raw tensors.

Two layouts occur in Ultralytics' exports (8.4):

- end-to-end, `[1, 300, 6 + extra]` (`nms=False`, or `nms=True`): x1, y1, x2, y2, score, class and
  the extras, already chosen;
- raw, `[1, 4 + classes + extra, N]` (the default): centre x, centre y, width, height, a score a
  class and the extras for every anchor. From the one-to-many head these overlap and need
  non-maximum suppression; from the one-to-one head, as `training.export_yolo` writes it, the
  best 300 are taken as they are.

Extras are 32 mask coefficients, or keypoints of two or three numbers each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["MAX_DETECTIONS", "NMS_IOU", "choose_raw", "choose_rows", "suppress"]

MAX_DETECTIONS = 300
NMS_IOU = 0.7
_MAX_CANDIDATES = 30_000
_CLASS_OFFSET_PX = 7680.0


def choose_rows(output: NDArray[np.floating], confidence: float) -> NDArray[np.float32]:
    """Take the rows of an end-to-end output whose score exceeds the confidence.

    Parameters
    ----------
    output : ndarray, shape (rows, 6 + extra)
        x1, y1, x2, y2, score, class, extras.
    confidence : float
        0 to 1.

    Returns
    -------
    ndarray of float32, shape (N, 6 + extra)

    Examples
    --------
    >>> choose_rows(np.array([[0, 0, 4, 4, 0.9, 0], [0, 0, 4, 4, 0.3, 0]]), 0.3).shape
    (1, 6)
    """
    return np.asarray(output[output[:, 4] > confidence], np.float32)


def choose_raw(
    output: NDArray[np.floating], classes: int, confidence: float, *, one_to_one: bool
) -> NDArray[np.float32]:
    """Choose from a raw output.

    Parameters
    ----------
    output : ndarray, shape (4 + classes + extra, N)
        Centre x, centre y, width, height, scores, extras.
    classes : int
        How many classes.
    confidence : float
        0 to 1; a score must exceed it.
    one_to_one : bool
        True takes the best 300 (`Detect.get_topk_index`), False suppresses overlaps
        (`non_max_suppression` with IoU 0.7, within a class).

    Returns
    -------
    ndarray of float32, shape (M, 6 + extra)
        x1, y1, x2, y2, score, class, extras; best first.

    Examples
    --------
    >>> raw = np.array([[5.0, 5.1], [5, 5], [4, 4], [2, 2], [0.75, 0.5]])
    >>> choose_raw(raw, 1, 0.3, one_to_one=False).tolist()
    [[3.0, 4.0, 7.0, 6.0, 0.75, 0.0]]
    >>> len(choose_raw(raw, 1, 0.3, one_to_one=True))
    2
    """
    anchors = np.asarray(output[:, output[4 : 4 + classes].max(axis=0) > confidence].T, np.float32)
    boxes, scores, extras = np.split(anchors, [4, 4 + classes], axis=1)
    half = boxes[:, 2:] / 2
    boxes = np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)
    if one_to_one:
        best = _descending(scores.max(axis=1))[:MAX_DETECTIONS]
        # As Ultralytics: an anchor of the best may answer for more than one class.
        flat = _descending(scores[best].ravel())[:MAX_DETECTIONS]
        index, labels = best[flat // classes], flat % classes
    else:
        index = _descending(scores.max(axis=1))[:_MAX_CANDIDATES]
        labels = scores[index].argmax(axis=1)
        kept = suppress(boxes[index] + labels[:, None].astype(np.float32) * _CLASS_OFFSET_PX)
        index, labels = index[kept][:MAX_DETECTIONS], labels[kept][:MAX_DETECTIONS]
    score = scores[index, labels]
    rows = np.column_stack([boxes[index], score, labels, extras[index]]).astype(np.float32)
    return rows[score > confidence]


def suppress(boxes: NDArray[np.float32], iou: float = NMS_IOU) -> NDArray[np.intp]:
    """Drop every box that overlaps a better one (greedy non-maximum suppression).

    Parameters
    ----------
    boxes : ndarray, shape (N, 4)
        x1, y1, x2, y2, best first.
    iou : float
        Overlap above which the worse is dropped.

    Returns
    -------
    ndarray of int
        Indices of the boxes kept, in order.

    Examples
    --------
    >>> suppress(np.array([[0, 0, 4, 4], [0, 0, 4, 3.9], [2, 0, 6, 4]], np.float32)).tolist()
    [0, 2]
    """
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    left = np.arange(len(boxes))
    kept = []
    while len(left):
        first, left = left[0], left[1:]
        kept.append(first)
        low = np.maximum(boxes[first, :2], boxes[left, :2])
        high = np.minimum(boxes[first, 2:], boxes[left, 2:])
        overlap = np.clip(high - low, 0, None).prod(axis=1)
        # Written without a division, so that boxes without area are no special case.
        left = left[overlap <= iou * (area[first] + area[left] - overlap)]
    return np.array(kept, np.intp)


def _descending(values: NDArray[np.float32]) -> NDArray[np.intp]:
    return np.argsort(-values, kind="stable")
