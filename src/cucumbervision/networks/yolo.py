"""YOLO detection with any Ultralytics ONNX export for detect, segment or pose."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.fruit.instance import TRUSTED_SHARE, UNKNOWN_ORDER, Instance
from cucumbervision.fruit.masks import box_ious
from cucumbervision.networks.confidence import DEFAULT_CONFIDENCE, LARGEST_INPUT_PX, detector_floor
from cucumbervision.networks.resize import Letterbox, fit
from cucumbervision.networks.runtime import Network, open_network
from cucumbervision.networks.yolo_layout import (
    RowKind,
    choose_raw,
    choose_rows,
    raw_of,
    read_layout,
)
from cucumbervision.threads import OneThread

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray


_KEYPOINTS = 5

_log = logging.getLogger("cucumbervision")


class YoloDetector:
    """A YOLO network with its pre- and post-processing: letterbox, decoding, full-resolution masks.

    Parameters
    ----------
    path : Path, str, bytes or Network
        An ONNX file, or one that is loaded.
    runtime : str
        As for `open_network`.
    confidence : float
        A detection's score must exceed it, 0 to 1.
    full_precision : bool
        As for `open_network`.
    most_fruit : int, optional
        Largest number of detections per picture. A very low confidence gives hundreds, each with a
        full-size mask.
    input_sizes : tuple of int
        Input sizes (long sides, pixels), multiples of the stride; detections at several are merged
        (`merge_sizes`). Empty for the file's default.

    Raises
    ------
    ModelError
        If the file cannot be loaded, is not a YOLO network with batch size 1, or has another fixed
        size.
    """

    def __init__(
        self,
        path: Path | str | bytes | Network,
        runtime: str = "auto",
        confidence: float = DEFAULT_CONFIDENCE,
        full_precision: bool = False,
        most_fruit: int | None = None,
        input_sizes: tuple[int, ...] = (),
    ) -> None:
        self._network = (
            path
            if isinstance(path, Network)
            else open_network(path, runtime, full_precision=full_precision)
        )
        self._most_fruit = most_fruit
        self._layout = read_layout(self._network)
        self._confidence = confidence
        sides_px = input_sizes or self._layout.sizes_px
        self._sizes_px = tuple((side, side) for side in sides_px) or (self._layout.size_px,)
        self._check_sizes()
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
    def confidence(self) -> float:
        """Threshold for a detection, 0 to 1."""
        return self._confidence

    @property
    def looks(self) -> int:
        """Number of input sizes."""
        return len(self._sizes_px)

    @property
    def by_place(self) -> bool:
        """Whether its keypoints are ordered by position, not from end to end."""
        return self._layout.by_place

    @property
    def runtime(self) -> str:
        """The runtime, as `Network.runtime`."""
        return self._network.runtime

    @OneThread()
    def detect(
        self, color_rgb: NDArray[np.uint8], confidence: float | None = None
    ) -> tuple[Instance, ...]:
        """Find fruit in one picture, at every input size.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.
        confidence : float, optional
            Threshold, instead of the detector's own.

        Returns
        -------
        tuple of Instance
            Best first: boxes clipped to the picture, `detector_mask` from a segmenting network
            (None where it is empty), `keypoints` from a pose network. Detections outside the
            picture are omitted.

        Raises
        ------
        ModelError
            If the network fails, or its output has no known layout.
        """
        confidence = self._confidence if confidence is None else confidence
        least_confidence = detector_floor(confidence, votes=len(self._sizes_px) > 1)
        by_size = [self._detect_at(color_rgb, size, least_confidence) for size in self._sizes_px]
        merged = merge_sizes(by_size)[: self._most_fruit]
        detections = tuple(detection for detection in merged if detection.confidence > confidence)
        if not self._layout.by_place:
            return detections
        return tuple(replace(detection, end_confidence=UNKNOWN_ORDER) for detection in detections)

    def _check_sizes(self) -> None:
        layout = self._layout
        for size_px in self._sizes_px:
            if not 0 < min(size_px) <= max(size_px) <= LARGEST_INPUT_PX:
                raise ModelError(
                    f"its input is {size_px[1]}x{size_px[0]} pixels",
                    source=layout.source,
                    remedy=f"export it for at most {LARGEST_INPUT_PX} pixels a side",
                )
            if not layout.free_size and size_px != layout.size_px:
                raise ModelError(
                    f"it takes {layout.size_px[1]}x{layout.size_px[0]} only, not {size_px[0]}",
                    source=layout.source,
                    remedy="leave --input-size out, or export the network with dynamic sizes",
                )
            if size_px[0] % layout.stride_px:
                raise ModelError(
                    f"its input must be a multiple of {layout.stride_px}, not {size_px[0]}",
                    source=layout.source,
                    remedy="choose another --input-size",
                )

    def _detect_at(
        self, color_rgb: NDArray[np.uint8], size_px: tuple[int, int], confidence: float
    ) -> tuple[Instance, ...]:
        layout = self._layout
        height, width = color_rgb.shape[:2]
        box = fit(height, width, size_px, minimal=layout.free_size, stride=layout.stride_px)
        outputs = self._network.run({layout.input_name: box.as_input(color_rgb)})
        output = outputs[layout.rows_name][0]
        kind, classes = layout.rows_of(output.shape, (box.input_height, box.input_width))
        rows = (
            choose_rows(output, confidence, source=layout.source)
            if kind is RowKind.FINAL
            else choose_raw(
                raw_of(output, kind, classes), classes, confidence, one_to_one=layout.one_to_one
            )
        )
        prototypes = outputs[layout.prototypes_name] if layout.prototypes_name else None
        detections = self._instances(rows[: self._most_fruit], prototypes, box)
        return tuple(replace(detection, input_size_px=max(size_px)) for detection in detections)

    def _instances(
        self, rows: NDArray[np.float32], prototypes: NDArray[np.float32] | None, box: Letterbox
    ) -> tuple[Instance, ...]:
        instances = []
        for row, edges in zip(rows, box.boxes_back(rows[:, :4]), strict=True):
            if edges[2] <= edges[0] or edges[3] <= edges[1]:
                continue
            label = int(row[5])
            instance = Instance(
                box=edges, confidence=float(row[4]), class_name=self.names.get(label, str(label))
            )
            if prototypes is not None:
                mask = box.mask_back(prototypes[0], row[6:], edges)
                instance = replace(instance, detector_mask=mask if mask.any() else None)
            elif self._layout.keypoints[0] == _KEYPOINTS:
                instance = replace(instance, keypoints=self._keypoints(row[6:], box))
            instances.append(instance)
        return tuple(instances)

    def _keypoints(self, values: NDArray[np.float32], box: Letterbox) -> NDArray[np.float64]:
        points = values.reshape(self._layout.keypoints)
        visibility = points[:, 2:3] if points.shape[1] > 2 else np.ones((_KEYPOINTS, 1))
        return np.column_stack([box.points_back(points[:, :2]), visibility])


SAME_IOU = 0.5
"""IoU above which two boxes are the same detection."""


def merge_sizes(by_size: Sequence[Sequence[Instance]]) -> tuple[Instance, ...]:
    """Merge a network's detections at several input sizes, best first.

    The confidence is the mean over the sizes, with 0 for sizes that miss it: a fruit seen at
    one of two sizes gets half its confidence (as in weighted boxes fusion, Solovyev et al., 2021).

    Parameters
    ----------
    by_size : sequence of sequence of Instance
        Detections by size; those of a single size stay as they are.

    Returns
    -------
    tuple of Instance
        Boxes of one class that overlap by an IoU of more than 0.5 are merged: the box is the mean
        weighted by confidence, everything else is from the first size that gives it at least half
        of the best confidence. Boxes that overlap less are merged by their masks, as at one size
        (`merge_instances`).

    Examples
    --------
    >>> small = Instance(np.array([0.0, 0, 100, 20]), 0.6, input_size_px=640)
    >>> large = Instance(np.array([0.0, 0, 96, 20]), 0.9, input_size_px=896)
    >>> (best,) = merge_sizes([[small], [large]])
    >>> best.confidence, best.box.round(1).tolist(), best.input_size_px
    (0.75, [0.0, 0.0, 97.6, 20.0], 640)
    >>> merge_sizes([[small], []])[0].confidence
    0.3
    """
    if len(by_size) < 2:
        return tuple(instance for instances in by_size for instance in instances)
    groups: list[dict[int, Instance]] = []
    finds = [(size, instance) for size, instances in enumerate(by_size) for instance in instances]
    for size, instance in sorted(finds, key=lambda pair: -pair[1].confidence):
        free = [group for group in groups if size not in group]
        firsts = [next(iter(group.values())) for group in free]
        ious = box_ious(
            instance.box[None], np.array([first.box for first in firsts]).reshape(-1, 4)
        )[0]
        ious *= [first.class_name == instance.class_name for first in firsts]
        if ious.size and ious.max() > SAME_IOU:
            free[int(ious.argmax())][size] = instance
        else:
            groups.append({size: instance})
    merged = [_mean_find(group, len(by_size)) for group in groups]
    return tuple(sorted(merged, key=lambda instance: -instance.confidence))


def _mean_find(finds: Mapping[int, Instance], sizes: int) -> Instance:
    confidences = [find.confidence for find in finds.values()]
    box = np.average([find.box for find in finds.values()], axis=0, weights=confidences)
    least_confidence = TRUSTED_SHARE * max(confidences)
    sure = [size for size, find in finds.items() if find.confidence >= least_confidence]
    return replace(finds[min(sure)], box=box, confidence=sum(confidences) / sizes)
