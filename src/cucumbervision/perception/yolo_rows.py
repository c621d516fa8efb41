"""Determine the layout of a YOLO network's output rows, and select the detections."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.instances.boxes import suppress

if TYPE_CHECKING:
    from numpy.typing import NDArray

_STRIDES_PX = (8, 16, 32)
_ANCHORS_A_CELL = 3


class RowKind(StrEnum):
    """Layout of an output's detections.

    `FINAL`: (N, 6 + extra), x1, y1, x2, y2, score, class, extras; `RAW`: (4 + classes + extra, N),
    centre, size, scores, extras; `RAW_ROWS`: the same transposed; `OBJECT_ROWS`: YOLOv5's and
    YOLOv7's (N, 5 + classes + extra), centre, size, objectness, scores, extras.
    """

    FINAL = "final"
    RAW = "raw"
    RAW_ROWS = "raw-rows"
    OBJECT_ROWS = "object-rows"


def row_kind(
    shape: tuple[int, ...], *, classes: int, extra: int, input_px: tuple[int, int], end_to_end: bool
) -> tuple[RowKind, int] | None:
    """Return the layout of an output and its number of classes; None for an unknown layout.

    The number of rows distinguishes layouts with equal columns: a raw output has one row for each
    cell of the three grids, YOLOv5 has three, and final rows are at most 1,000.

    Parameters
    ----------
    shape : tuple of int
        Shape of the detections without the batch.
    classes : int
        Number of class names in the file; 0 if it has none.
    extra : int
        Numbers per detection beside box and classes.
    input_px : tuple of int
        Height and width of the input.
    end_to_end : bool
        Whether the rows are final according to the file.

    Examples
    --------
    >>> size = {"extra": 0, "input_px": (640, 640), "end_to_end": False}
    >>> row_kind((25200, 6), classes=1, **size)
    (<RowKind.OBJECT_ROWS: 'object-rows'>, 1)
    >>> row_kind((300, 6), classes=1, **size)
    (<RowKind.FINAL: 'final'>, 1)
    >>> row_kind((5, 8400), classes=1, **size)
    (<RowKind.RAW: 'raw'>, 1)
    """
    first, last = shape
    cells = sum((input_px[0] // stride) * (input_px[1] // stride) for stride in _STRIDES_PX)
    if last == 6 + extra and end_to_end:
        return RowKind.FINAL, classes
    for count, kind, class_count in (
        (last, RowKind.RAW, first - 4 - extra),
        (first, RowKind.RAW_ROWS, last - 4 - extra),
        (first, RowKind.OBJECT_ROWS, last - 5 - extra),
    ):
        expected = cells * (_ANCHORS_A_CELL if kind is RowKind.OBJECT_ROWS else 1)
        if count == expected and class_count > 0 and class_count == (classes or class_count):
            return kind, class_count
    if last == 6 + extra and first not in (cells, _ANCHORS_A_CELL * cells):
        return RowKind.FINAL, classes
    raw_classes = classes or first - 4 - extra  # of grids with other strides
    if raw_classes > 0 and first == 4 + raw_classes + extra and (classes or first < last):
        return RowKind.RAW, raw_classes
    return None


def raw_of(output: NDArray[np.floating], kind: RowKind, classes: int) -> NDArray[np.floating]:
    """Convert an output that is not final to `RowKind.RAW`; objectness is multiplied into scores.

    Examples
    --------
    >>> raw_of(np.array([[5.0, 5, 4, 4, 0.5, 0.5]]), RowKind.OBJECT_ROWS, 1).ravel().tolist()
    [5.0, 5.0, 4.0, 4.0, 0.25]
    """
    if kind is RowKind.RAW:
        return output
    if kind is RowKind.RAW_ROWS:
        return output.T
    boxes, objectness, scores, extras = np.split(output, [4, 5, 5 + classes], axis=1)
    return np.concatenate([boxes, objectness * scores, extras], axis=1).T


_MAX_DETECTIONS = 300

_NMS_IOU = 0.7


def choose_rows(
    output: NDArray[np.floating], confidence: float, *, source: str = ""
) -> NDArray[np.float32]:
    """Take the rows of an end-to-end output whose score exceeds the confidence.

    Parameters
    ----------
    output : ndarray, shape (rows, 6 + extra)
        x1, y1, x2, y2, score, class, extras.
    confidence : float
        0 to 1.
    source : str
        The file, for errors.

    Returns
    -------
    ndarray of float32, shape (N, 6 + extra)

    Raises
    ------
    ModelError
        If the rows are of another kind: a class that is no whole number, a score beyond 1, or
        boxes of which most have no area.

    Examples
    --------
    >>> choose_rows(np.array([[0, 0, 4, 4, 0.9, 0], [0, 0, 4, 4, 0.3, 0]]), 0.3).shape
    (1, 6)
    """
    rows = np.asarray(output[output[:, 4] > confidence], np.float32)
    labels, empty = output[:, 5], (rows[:, 2:4] <= rows[:, :2]).any(axis=1)
    is_label = (labels >= 0) & (labels % 1 == 0)
    if not is_label.all() or (rows[:, 4] > 1).any() or 2 * empty.sum() > len(rows):
        raise ModelError(
            "its rows are not x1, y1, x2, y2, score, class",
            source=source,
            remedy="name an ONNX export of a YOLO detect, segment or pose network",
        )
    return rows


def choose_raw(
    output: NDArray[np.floating], classes: int, confidence: float, *, one_to_one: bool
) -> NDArray[np.float32]:
    """Select the detections of a raw output.

    Parameters
    ----------
    output : ndarray, shape (4 + classes + extra, N)
        Centre x, centre y, width, height, scores, extras.
    classes : int
        Number of classes.
    confidence : float
        0 to 1; a score must exceed it.
    one_to_one : bool
        True keeps the best 300 (`Detect.get_topk_index`); False suppresses overlaps within a class
        (`non_max_suppression`, IoU 0.7).

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
        best = _descending(scores.max(axis=1))[:_MAX_DETECTIONS]
        # As in Ultralytics, one anchor may give detections of several classes.
        flat = _descending(scores[best].ravel())[:_MAX_DETECTIONS]
        index, labels = best[flat // classes], flat % classes
    else:
        labels = scores.argmax(axis=1)
        index = suppress(boxes, scores.max(axis=1), labels, _NMS_IOU)[:_MAX_DETECTIONS]
        labels = labels[index]
    score = scores[index, labels]
    rows = np.column_stack([boxes[index], score, labels, extras[index]]).astype(np.float32)
    return rows[score > confidence]


def _descending(values: NDArray[np.float32]) -> NDArray[np.intp]:
    return np.argsort(-values, kind="stable")
