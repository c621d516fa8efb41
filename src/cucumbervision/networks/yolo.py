"""YOLO detection with any Ultralytics ONNX export for detect, segment or pose.

Ultralytics measures from the image's corner (pixel i covers i to i + 1), cameras and `Instance`
from the first pixel's centre (pixel i covers i - 0.5 to i + 0.5); the way back subtracts 0.5.
Sources: `LetterBox`, `scale_boxes`, `scale_coords` and `process_mask_native` of Ultralytics 8.4.
"""

from __future__ import annotations

import ast
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field, PositiveInt

from cucumbervision.arrays import Array, Array32, Ints, Mask, Pixels
from cucumbervision.errors import CucumberVisionError, ModelError, as_errors_of
from cucumbervision.files import parse_model
from cucumbervision.fruit.instance import TRUSTED_SHARE, UNKNOWN_ORDER, Instance
from cucumbervision.fruit.masks import box_ious, suppress
from cucumbervision.networks import DEFAULT_CONFIDENCE, LARGEST_INPUT_PX
from cucumbervision.networks.runtime import Network, TensorInfo, input_planes, open_network
from cucumbervision.tube.compiled import OneThread

ONE_TO_ONE_KEY = "one2one"
"""Metadata key of our exports: 'True' if the raw output is from the one-to-one head."""

ORDER_KEY = "keypoint_order"
"""Metadata key of our pose exports; without it points run from blossom to stem."""

SIZES_KEY = "input_sizes"
"""Metadata key of our exports: default input sizes (long sides)."""

BY_PLACE = "place"
"""Its value if points run from a fruit's lower left to its upper right end."""

_KEYPOINTS = 5
_POSE_CONFIDENCE = 0.05
_FLOOR_SHARE = 1 / 3
_SIZE_STEP_PX = 32
_GREY = 114
_REMEDY = "name an ONNX export of a YOLO detect, segment or pose network"
_log = logging.getLogger("cucumbervision")


def _literal(text: str) -> Any:
    """Return a value that Ultralytics wrote with `str()`."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def _by_number(names: Any) -> Any:
    return dict(enumerate(names)) if isinstance(names, list | tuple) else names


@dataclass(frozen=True)
class _Metadata:
    """What Ultralytics' exports say of themselves."""

    names: Annotated[dict[int, str], BeforeValidator(_by_number)] = field(default_factory=dict)
    imgsz: tuple[PositiveInt, PositiveInt] = (640, 640)
    stride: Annotated[int, Field(ge=1, le=1024)] = 32
    kpt_shape: tuple[PositiveInt, PositiveInt] = (0, 0)
    end2end: bool = False
    args: dict[str, Any] = field(default_factory=dict)
    task: Literal["", "detect", "segment", "pose"] = ""


def detector_floor(confidence: float, *, votes: bool) -> float:
    """Return the detector's threshold for candidates.

    Parameters
    ----------
    confidence : float
        Threshold for a fruit.
    votes : bool
        Whether other input sizes or a pose network vote, which may lift a candidate over the
        threshold.

    Examples
    --------
    >>> detector_floor(0.3, votes=False)
    0.3
    >>> round(detector_floor(0.3, votes=True), 3)
    0.1
    """
    return confidence * (_FLOOR_SHARE if votes else 1)


def pose_floor(confidence: float) -> float:
    """Return the pose network's threshold for keypoints of a fruit that the detector found.

    Parameters
    ----------
    confidence : float
        Threshold for a fruit.

    Examples
    --------
    >>> pose_floor(0.3)
    0.05
    >>> pose_floor(0.01)
    0.01
    """
    return min(confidence, _POSE_CONFIDENCE)


def parse_input_sizes(text: str) -> tuple[int, ...]:
    """Parse the option `--input-size`: one size in pixels, or several to merge.

    Parameters
    ----------
    text : str
        Multiples of 32 up to 4096, joined by commas; empty for the network's own size.

    Returns
    -------
    tuple of int
        Each size once, the smallest first.

    Raises
    ------
    CucumberVisionError
        For anything else.

    Examples
    --------
    >>> parse_input_sizes("1280,640"), parse_input_sizes("")
    ((640, 1280), ())
    """
    parts = [part.strip() for part in text.split(",")] if text.strip() else []
    sizes = {int(part) if part.isdecimal() and len(part) < 6 else 0 for part in parts}
    if not all(0 < size <= LARGEST_INPUT_PX and size % _SIZE_STEP_PX == 0 for size in sizes):
        raise CucumberVisionError(
            f"{text!r} is not an input size",
            source="--input-size",
            remedy=f"give a multiple of {_SIZE_STEP_PX} up to {LARGEST_INPUT_PX}, such as 640, "
            "or several joined by commas",
        )
    return tuple(sorted(sizes))


@dataclass(frozen=True)
class Letterbox:
    """Position of an image in a network's input; made by `fit`.

    Parameters
    ----------
    height, width : int
        The image's size in pixels.
    input_height, input_width : int
        The network input's size.
    inner_height, inner_width : int
        The resized image's size inside it.
    top_px, left_px : int
        Grey rows above and columns to the left.

    Examples
    --------
    >>> box = fit(720, 1280, (640, 640))
    >>> (box.inner_height, box.inner_width, box.top_px, box.left_px)
    (360, 640, 140, 0)
    >>> box.boxes_back(np.array([[0.0, 140, 320, 320]])).tolist()
    [[-0.5, -0.5, 639.5, 359.5]]
    """

    height: int
    width: int
    input_height: int
    input_width: int
    inner_height: int
    inner_width: int
    top_px: int
    left_px: int

    def apply(self, color_rgb: Pixels) -> Pixels:
        """Resize linearly and pad with grey.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (height, width, 3)
            The image.

        Returns
        -------
        ndarray of uint8, shape (input_height, input_width, 3)
        """
        size = self.inner_width, self.inner_height
        inner = cv2.resize(color_rgb, size, interpolation=cv2.INTER_LINEAR)
        out = np.full((self.input_height, self.input_width, 3), _GREY, np.uint8)
        rows, columns = self.inner_height, self.inner_width
        out[self.top_px : self.top_px + rows, self.left_px : self.left_px + columns] = inner
        return out

    def as_input(self, color_rgb: Pixels) -> Array32:
        """Return the network's input, RGB from 0 to 1, shape (1, 3, input_height, input_width)."""
        return input_planes(self.apply(color_rgb)[None])

    def boxes_back(self, boxes: NDArray[np.floating]) -> Array:
        """Map boxes from the network's input to the image, and clip them.

        Parameters
        ----------
        boxes : ndarray, shape (N, 4)
            x1, y1, x2, y2 in the input's pixels, from its corner.

        Returns
        -------
        ndarray of float64, shape (N, 4)
            The same in the image's pixels, from its first pixel's centre.
        """
        return self.points_back(np.reshape(boxes, (-1, 2, 2))).reshape(-1, 4)

    def points_back(self, points: NDArray[np.floating]) -> Array:
        """Map points from the network's input to the image, and clip them.

        Parameters
        ----------
        points : ndarray, shape (..., 2)
            u, v in the input's pixels, from its corner.

        Returns
        -------
        ndarray of float64, shape (..., 2)
            The same in the image's pixels, from its first pixel's centre.
        """
        # Each side has its own gain, since each was rounded to whole pixels.
        gain = self.inner_width / self.width, self.inner_height / self.height
        original = (np.asarray(points, np.float64) - (self.left_px, self.top_px)) / gain
        return np.clip(original, 0.0, (self.width, self.height)) - 0.5

    def mask_back(
        self, prototypes: Array32, coefficients: Array32, box: NDArray[np.floating]
    ) -> Mask:
        """Map one mask from the prototypes' grid to the image, and crop it to its box.

        The prototypes' weighted sum is interpolated linearly and cut at zero at the image's own
        resolution (`process_mask_native`, Ultralytics' `retina_masks`); only the part that the
        box needs is computed.

        Parameters
        ----------
        prototypes : ndarray of float32, shape (C, h, w)
            On a grid of a quarter of the input.
        coefficients : ndarray of float32, shape (C,)
            The detection's weight of each.
        box : ndarray, shape (4,)
            x1, y1, x2, y2 in the image's pixels, from its first pixel's centre.

        Returns
        -------
        ndarray of bool, shape (height, width)
        """
        mask = np.zeros((self.height, self.width), np.bool_)
        # Pixel i is inside where x1 <= i < x2, counted from the corner.
        x1, y1, x2, y2 = np.ceil(np.asarray(box, np.float64) + 0.5).astype(int)
        down, across = _mask_weights(self, *prototypes.shape[1:])
        down, across = down[y1:y2], across[x1:x2]
        rows, columns = _span(down.any(axis=0)), _span(across.any(axis=0))
        logits = np.tensordot(coefficients, prototypes[:, rows, columns], axes=1)
        mask[y1:y2, x1:x2] = down[:, rows] @ logits @ across[:, columns].T > 0
        return mask


def fit(
    height: int, width: int, size: tuple[int, int], *, minimal: bool = False, stride: int = 32
) -> Letterbox:
    """Compute the position of an image in a network's input.

    Parameters
    ----------
    height, width : int
        The image's size in pixels.
    size : tuple of int
        Height and width of the network's input.
    minimal : bool
        Pad only to the next multiple of `stride`, as Ultralytics does for networks with free size
        (`rect`).
    stride : int
        The network's largest stride in pixels.

    Returns
    -------
    Letterbox

    Examples
    --------
    >>> box = fit(720, 1280, (640, 640), minimal=True)
    >>> (box.input_height, box.input_width, box.top_px)
    (384, 640, 12)
    """
    gain = min(size[0] / height, size[1] / width)
    inner_height, inner_width = max(round(height * gain), 1), max(round(width * gain), 1)
    spare_rows, spare_columns = size[0] - inner_height, size[1] - inner_width
    if minimal:
        spare_rows, spare_columns = spare_rows % stride, spare_columns % stride
    return Letterbox(
        height=height,
        width=width,
        input_height=inner_height + spare_rows,
        input_width=inner_width + spare_columns,
        inner_height=inner_height,
        inner_width=inner_width,
        # The smaller half goes above and left: round(x.5 - 0.1) is x.
        top_px=spare_rows // 2,
        left_px=spare_columns // 2,
    )


@lru_cache(maxsize=8)
def _mask_weights(box: Letterbox, rows: int, columns: int) -> tuple[Array32, Array32]:
    """Return the matrices that interpolate the prototypes' rows and columns to the image's."""
    return (
        _linear_weights(rows, box.input_height, box.top_px, box.inner_height, box.height),
        _linear_weights(columns, box.input_width, box.left_px, box.inner_width, box.width),
    )


def _linear_weights(cells: int, input_px: int, start_px: int, inner_px: int, size: int) -> Array32:
    """Return what each of `cells` along a side adds to each of `size` pixels, (size, cells).

    The image's side lies at `start_px`, `inner_px` long, in an input of `input_px`. Cells in the
    padding add nothing.
    """
    cell = (start_px + (np.arange(size) + 0.5) * inner_px / size) * cells / input_px - 0.5
    first = np.ceil(start_px * cells / input_px)
    last = np.floor((start_px + inner_px) * cells / input_px) - 1
    cell = np.clip(cell, first, max(first, last))
    weights = np.maximum(1 - np.abs(cell[:, None] - np.arange(cells)), 0)
    return np.asarray(weights, np.float32)


def _span(flags: ArrayLike) -> slice:
    """Return the slice from the first to the last set flag; slice(0, 0) if there is none."""
    indices = np.flatnonzero(flags)
    return slice(int(indices[0]), int(indices[-1]) + 1) if len(indices) else slice(0, 0)


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
        Largest number of detections per image. A very low confidence gives hundreds, each with a
        full-size mask.
    input_sizes : tuple of int
        Input sizes (long sides, pixels), multiples of the stride; detections at several are merged
        (`merge_sizes`). Empty for the file's default.

    Attributes
    ----------
    names : mapping of int to str
        The class names, by the class's number; empty where the file has none.
    task : str
        'detect', 'segment' or 'pose'.
    confidence : float
        Threshold for a detection, 0 to 1.
    looks : int
        Number of input sizes.
    by_place : bool
        Whether its keypoints are ordered by position, not from end to end.
    runtime : str
        The runtime, as `Network.runtime`.

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
        if not isinstance(path, Network):
            path = open_network(path, runtime, full_precision=full_precision)
        network = path
        self._network, self.runtime = network, network.runtime
        self.confidence, self._most_fruit = confidence, most_fruit
        self._fixed_px = self._input_size(network.inputs)
        rows = [output for output in network.outputs if len(output.shape) == 3]
        prototypes = [output for output in network.outputs if len(output.shape) == 4]
        self._metadata = metadata = self._read_metadata(network.metadata)
        self.task = metadata.task or ("segment" if prototypes else "detect")
        if len(rows) != 1 or len(prototypes) != (self.task == "segment"):
            raise self._refused(f"its outputs are {_shapes(network.outputs)}")
        self._rows, self._prototypes = rows[0].name, prototypes[0].name if prototypes else ""
        self._kpt_shape = metadata.kpt_shape if self.task == "pose" else (0, 0)
        self._extra = int(np.prod(self._kpt_shape))
        if prototypes:
            self._extra = int(prototypes[0].shape[1] or 32)
        self.names: Mapping[int, str] = metadata.names
        self.by_place = network.metadata.get(ORDER_KEY) == BY_PLACE
        with as_errors_of(network.source):
            sides_px = input_sizes or parse_input_sizes(network.metadata.get(SIZES_KEY, ""))
        own_px = self._fixed_px or metadata.imgsz
        self._sizes_px = tuple((side, side) for side in sides_px) or (own_px,)
        self.looks = len(self._sizes_px)
        self._check_sizes()
        _, channels, last = rows[0].shape
        if channels is not None and last is not None:
            self._kind_of((channels, last), own_px)
        if self.task == "pose" and self._kpt_shape[0] != _KEYPOINTS:
            words = "%s: it gives %d keypoints, a fruit has %d; only its boxes are used"
            _log.warning(words, network.source, self._kpt_shape[0], _KEYPOINTS)

    def _refused(self, fault: str, remedy: str = _REMEDY) -> ModelError:
        return ModelError(fault, source=self._network.source, remedy=remedy)

    def _input_size(self, inputs: Sequence[TensorInfo]) -> tuple[int, int] | None:
        """Return height and width of the input; None if they are free."""
        shape = inputs[0].shape if len(inputs) == 1 else ()
        if len(shape) != 4 or shape[1] not in (3, None):
            raise self._refused(f"its inputs are {_shapes(inputs)}")
        batch, _, height, width = shape
        if batch not in (1, None):
            raise self._refused(f"it takes {batch} pictures at once", "export it with batch=1")
        return None if height is None or width is None else (height, width)

    def _read_metadata(self, data: Mapping[str, str]) -> _Metadata:
        if data.get("task", "detect") not in ("detect", "segment", "pose"):
            raise self._refused(f"its task is {data['task']!r}")
        values = {key: _literal(data[key]) for key in _Metadata.__annotations__ if key in data}
        source, remedy = self._network.source, "export it again"
        return parse_model(_Metadata, values, source=source, error=ModelError, remedy=remedy)

    def _kind_of(self, shape: tuple[int, ...], input_px: tuple[int, int]) -> tuple[RowKind, int]:
        """Return the layout of an output's detections, and the number of classes."""
        kind = row_kind(
            shape,
            classes=len(self.names),
            extra=self._extra,
            input_px=input_px,
            end_to_end=self._metadata.end2end or bool(self._metadata.args.get("nms")),
        )
        if kind is not None:
            return kind
        raise self._refused(
            f"the output {shape[0]}x{shape[1]} is no {self.task} head of {len(self.names)} classes",
            "export it with Ultralytics, or from YOLOv5 or YOLOv7, without changes; other "
            "detectors take part from Python, as a function that returns instances",
        )

    @OneThread()
    def detect(self, color_rgb: Pixels, confidence: float | None = None) -> tuple[Instance, ...]:
        """Find fruit in one image, at every input size.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The image.
        confidence : float, optional
            Threshold, instead of the detector's own.

        Returns
        -------
        tuple of Instance
            Best first: boxes clipped to the image, `detector_mask` from a segmenting network
            (None where it is empty), `keypoints` from a pose network. Detections outside the
            image are omitted.

        Raises
        ------
        ModelError
            If the network fails, or its output has no known layout.
        """
        confidence = self.confidence if confidence is None else confidence
        least_confidence = detector_floor(confidence, votes=self.looks > 1)
        by_size = [self._detect_at(color_rgb, size, least_confidence) for size in self._sizes_px]
        merged = merge_sizes(by_size)[: self._most_fruit]
        detections = tuple(detection for detection in merged if detection.confidence > confidence)
        if not self.by_place:
            return detections
        return tuple(replace(detection, end_confidence=UNKNOWN_ORDER) for detection in detections)

    def _check_sizes(self) -> None:
        fixed, stride_px = self._fixed_px, self._metadata.stride
        for height, width in self._sizes_px:
            if not 0 < min(height, width) <= max(height, width) <= LARGEST_INPUT_PX:
                fault, remedy = f"its input is {width}x{height} pixels", "export it for at most"
                raise self._refused(fault, f"{remedy} {LARGEST_INPUT_PX} pixels a side")
            if fixed is not None and (height, width) != fixed:
                fault = f"it takes {fixed[1]}x{fixed[0]} only, not {height}"
                remedy = "leave --input-size out, or export the network with dynamic sizes"
                raise self._refused(fault, remedy)
            if height % stride_px:
                fault = f"its input must be a multiple of {stride_px}, not {height}"
                raise self._refused(fault, "choose another --input-size")

    def _detect_at(
        self, color_rgb: Pixels, size_px: tuple[int, int], confidence: float
    ) -> tuple[Instance, ...]:
        height, width = color_rgb.shape[:2]
        is_free, stride_px = self._fixed_px is None, self._metadata.stride
        box = fit(height, width, size_px, minimal=is_free, stride=stride_px)
        outputs = self._network.run({self._network.inputs[0].name: box.as_input(color_rgb)})
        output = outputs[self._rows][0]
        kind, classes = self._kind_of(output.shape, (box.input_height, box.input_width))
        if kind is RowKind.FINAL:
            rows = choose_rows(output, confidence, source=self._network.source)
        else:
            is_one_to_one = self._network.metadata.get(ONE_TO_ONE_KEY) == "True"
            raw = raw_of(output, kind, classes)
            rows = choose_raw(raw, classes, confidence, one_to_one=is_one_to_one)
        rows = rows[: self._most_fruit]
        instances = []
        for row, edges in zip(rows, box.boxes_back(rows[:, :4]), strict=True):
            if edges[2] <= edges[0] or edges[3] <= edges[1]:
                continue
            mask = keypoints = None
            if self._prototypes:
                mask = box.mask_back(outputs[self._prototypes][0], row[6:], edges)
            elif self._kpt_shape[0] == _KEYPOINTS:
                points = row[6:].reshape(self._kpt_shape)
                seen = points[:, 2:3] if points.shape[1] > 2 else np.ones((_KEYPOINTS, 1))
                keypoints = np.column_stack([box.points_back(points[:, :2]), seen])
            instance = Instance(
                edges,
                float(row[4]),
                self.names.get(int(row[5]), str(int(row[5]))),
                detector_mask=mask if mask is not None and mask.any() else None,
                keypoints=keypoints,
                input_size_px=max(size_px),
            )
            instances.append(instance)
        return tuple(instances)


def _shapes(tensors: Sequence[TensorInfo]) -> str:
    shapes = ("x".join("?" if n is None else str(n) for n in info.shape) for info in tensors)
    return ", ".join(f"{info.name} {shape}" for info, shape in zip(tensors, shapes, strict=True))


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
        boxes = np.array([first.box for first in firsts]).reshape(-1, 4)
        ious = box_ious(instance.box[None], boxes)[0]
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


def choose_rows(output: NDArray[np.floating], confidence: float, *, source: str = "") -> Array32:
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
) -> Array32:
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


def _descending(values: Array32) -> Ints:
    return np.argsort(-values, kind="stable")
