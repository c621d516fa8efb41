"""Find fruit with a YOLO network: any Ultralytics ONNX export for detect, segment or pose."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.perception.boxes import box_iou, suppress
from cucumbervision.perception.instances import Instance
from cucumbervision.perception.letterbox import Letterbox, fit
from cucumbervision.perception.runtime import open_network
from cucumbervision.perception.yolo_layout import read_layout

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.perception.ends import EndTeller

__all__ = [
    "DEFAULT_CONFIDENCE",
    "MAX_DETECTIONS",
    "NMS_IOU",
    "YoloDetector",
    "choose_raw",
    "choose_rows",
    "with_keypoints",
]

MAX_DETECTIONS = 300

NMS_IOU = 0.7


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
        labels = scores.argmax(axis=1)
        index = suppress(boxes, scores.max(axis=1), labels, NMS_IOU)[:MAX_DETECTIONS]
        labels = labels[index]
    score = scores[index, labels]
    rows = np.column_stack([boxes[index], score, labels, extras[index]]).astype(np.float32)
    return rows[score > confidence]


def _descending(values: NDArray[np.float32]) -> NDArray[np.intp]:
    return np.argsort(-values, kind="stable")


DEFAULT_CONFIDENCE = 0.30

_KEYPOINTS = 5

_log = logging.getLogger("cucumbervision")


class YoloDetector:
    """A YOLO network with everything around it: letterbox, decoding, masks at full resolution.

    Parameters
    ----------
    path : Path, str or bytes
        An ONNX file.
    runtime : str
        As for `open_network`.
    confidence : float
        A detection's score must exceed it, 0 to 1.
    full_precision : bool
        As for `open_network`.
    ends : EndTeller, optional
        Tells which end of a fruit is the stem's where the file says that its points are ordered
        by place. Without one such points keep their order, and nobody knows their ends.
    most : int, optional
        Detections a picture at most, the best ones: with next to no least confidence there are
        hundreds, and each mask is drawn at full size.

    Raises
    ------
    ModelError
        If the file cannot be loaded, or is no YOLO network for one picture at a time.
    """

    def __init__(
        self,
        path: Path | str | bytes,
        runtime: str = "auto",
        confidence: float = DEFAULT_CONFIDENCE,
        full_precision: bool = False,
        most: int | None = None,
        ends: EndTeller | None = None,
    ) -> None:
        self._network = open_network(path, runtime, full_precision=full_precision)
        self._most, self.ends = most, ends
        self._layout = read_layout(self._network)
        self._confidence = confidence
        if self.task == "pose" and self._layout.keypoints[0] != _KEYPOINTS:
            _log.warning(
                "%s: it gives %d keypoints, a fruit has %d; only its boxes are used",
                self._layout.source,
                self._layout.keypoints[0],
                _KEYPOINTS,
            )

    @property
    def names(self) -> Mapping[int, str]:
        """The class names, by the class's number."""
        return self._layout.names

    @property
    def task(self) -> str:
        """Either 'detect', 'segment' or 'pose'."""
        return self._layout.task

    @property
    def by_place(self) -> bool:
        """Whether its keypoints are ordered by where they lie, so that `ends` is needed."""
        return self._layout.by_place

    @property
    def runtime(self) -> str:
        """What runs it, as `Network.runtime`."""
        return self._network.runtime

    def detect(self, color_rgb: NDArray[np.uint8]) -> tuple[Instance, ...]:
        """Find fruit in one picture.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.

        Returns
        -------
        tuple of Instance
            Best first: boxes clipped to the picture, `detector_mask` from a segmenting network
            (None where it is empty), `keypoints` from a pose network. Detections that lie
            outside the picture are left out.

        Raises
        ------
        ModelError
            If the network fails, or its output has no known layout.
        """
        layout = self._layout
        height, width = color_rgb.shape[:2]
        box = fit(height, width, layout.size_px, minimal=layout.free_size, stride=layout.stride_px)
        planes = np.ascontiguousarray(box.apply(color_rgb).transpose(2, 0, 1)[None])
        # Divided, not multiplied by 1/255: the same float32 values as Ultralytics'.
        picture = np.divide(planes, np.float32(255), dtype=np.float32)
        outputs = self._network.run({layout.input_name: picture})
        output = outputs[layout.rows_name][0]
        classes = layout.raw_classes(output.shape)
        rows = (
            choose_rows(output, self._confidence)
            if classes is None
            else choose_raw(output, classes, self._confidence, one_to_one=layout.one_to_one)
        )
        prototypes = outputs[layout.prototypes_name][0] if layout.prototypes_name else None
        found = self._instances(rows[: self._most], prototypes, box)
        if not layout.by_place:
            return found
        if self.ends is None:
            return tuple(replace(one, end_confidence=0.5) for one in found)
        return self.ends.tell(color_rgb, found)

    def _instances(
        self, rows: NDArray[np.float32], prototypes: NDArray[np.float32] | None, box: Letterbox
    ) -> tuple[Instance, ...]:
        boxes = box.boxes_back(rows[:, :4])
        found = []
        for row, edges in zip(rows, boxes, strict=True):
            if edges[2] <= edges[0] or edges[3] <= edges[1]:
                continue
            label = int(row[5])
            instance = Instance(
                box=edges, confidence=float(row[4]), class_name=self.names.get(label, str(label))
            )
            if prototypes is not None:
                mask = box.mask_back(prototypes, row[6:], edges)
                instance = replace(instance, detector_mask=mask if mask.any() else None)
            elif self._layout.keypoints[0] == _KEYPOINTS:
                instance = replace(instance, keypoints=self._keypoints(row[6:], box))
            found.append(instance)
        return tuple(found)

    def _keypoints(self, values: NDArray[np.float32], box: Letterbox) -> NDArray[np.float64]:
        points = values.reshape(self._layout.keypoints)
        visibility = points[:, 2:3] if points.shape[1] > 2 else np.ones((_KEYPOINTS, 1))
        return np.column_stack([box.points_back(points[:, :2]), visibility])


def with_keypoints(
    instances: Sequence[Instance], poses: Sequence[Instance], min_iou: float = 0.5
) -> tuple[Instance, ...]:
    """Return instances with the keypoints that a pose network found for them.

    Boxes are matched one to one, so that the sum of their overlaps is largest.

    Parameters
    ----------
    instances : sequence of Instance
        From a segmenting network, or from anywhere.
    poses : sequence of Instance
        With keypoints.
    min_iou : float
        Least overlap of the two boxes.

    Returns
    -------
    tuple of Instance
        The instances in their order; those without a match keep what they had.

    Examples
    --------
    >>> fruit = Instance(np.array([0.0, 0, 10, 40]))
    >>> pose = Instance(np.array([0.0, 0, 10, 38]), keypoints=np.zeros((5, 3)))
    >>> with_keypoints([fruit], [pose])[0].keypoints.shape
    (5, 3)
    """
    if not instances or not poses:
        return tuple(instances)
    from scipy.optimize import linear_sum_assignment

    overlaps = np.array([[box_iou(a.box, b.box) for b in poses] for a in instances])
    # Pairs below the threshold count nothing, so that they push no good pair aside.
    overlaps[overlaps < min_iou] = 0.0
    out = list(instances)
    rows, columns = linear_sum_assignment(overlaps, maximize=True)
    for i, j in zip(rows.tolist(), columns.tolist(), strict=True):
        if overlaps[i, j] > 0 and poses[j].keypoints is not None:
            out[i] = replace(
                instances[i], keypoints=poses[j].keypoints, end_confidence=poses[j].end_confidence
            )
    return tuple(out)
