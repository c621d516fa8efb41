"""YOLO detection with any Ultralytics ONNX export for detect, segment or pose."""

from __future__ import annotations

import ast
import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import CucumberVisionError, ModelError
from cucumbervision.instances.instance import Instance, mirrored
from cucumbervision.perception.card import CardArray
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE, detector_floor
from cucumbervision.perception.input_sizes import (
    LARGEST_INPUT_PX,
    merge_sizes,
    parse_input_sizes,
)
from cucumbervision.perception.network import Network
from cucumbervision.perception.resize import Letterbox, fit
from cucumbervision.perception.runtime import open_network
from cucumbervision.perception.yolo_rows import (
    RowKind,
    choose_raw,
    choose_rows,
    raw_of,
    row_kind,
)
from cucumbervision.threads import OneThread

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.perception.network import TensorInfo

ONE_TO_ONE_KEY = "one2one"
"""Metadata key of our exports: 'True' if the raw output is from the one-to-one head."""

ORDER_KEY = "keypoint_order"
"""Metadata key of our pose exports; without it points run from blossom to stem."""

SIZES_KEY = "input_sizes"
"""Metadata key of our exports: default input sizes (long sides)."""

BY_PLACE = "place"
"""Its value if points run from a fruit's lower left to its upper right end."""

_TASKS = ("detect", "segment", "pose")
_REMEDY = "name an ONNX export of a YOLO detect, segment or pose network"
_DEFAULT_SIZE_PX = 640
_DEFAULT_STRIDE_PX = 32
_LARGEST_STRIDE_PX = 1024


@dataclass(frozen=True)
class YoloLayout:
    """Layout of the inputs and outputs of a YOLO network.

    Parameters
    ----------
    task : str
        'detect', 'segment' or 'pose'.
    names : mapping of int to str
        The class names; empty where the file has none.
    input_name : str
        The picture's input.
    rows_name, prototypes_name : str
        The outputs; no prototypes ('') unless the task is 'segment'.
    size_px : tuple of int
        Height and width of the input.
    sizes_px : tuple of int
        Default input sizes of the file; empty for `size_px` alone.
    free_size : bool
        True if the network takes any multiple of the stride.
    stride_px : int
        Its largest stride.
    extra : int
        Numbers per detection beside box and classes: mask coefficients or keypoints.
    keypoints : tuple of int
        Keypoints, and numbers per keypoint; (0, 0) unless the task is 'pose'.
    end_to_end : bool
        True if the file's metadata says that its rows are final.
    one_to_one : bool
        True if the raw rows need no suppression.
    by_place : bool
        True if keypoints are ordered by their position in the picture.
    source : str
        The file, for errors.
    """

    task: str
    names: Mapping[int, str]
    input_name: str
    rows_name: str
    prototypes_name: str
    size_px: tuple[int, int]
    sizes_px: tuple[int, ...]
    free_size: bool
    stride_px: int
    extra: int
    keypoints: tuple[int, int]
    end_to_end: bool
    one_to_one: bool
    by_place: bool
    source: str

    def rows_of(
        self, shape: tuple[int, ...], input_px: tuple[int, int] | None = None
    ) -> tuple[RowKind, int]:
        """Return the layout of an output's detections, and the number of classes.

        Parameters
        ----------
        shape : tuple of int
            Shape of the detections without the batch: (a, b).
        input_px : tuple of int, optional
            Height and width of the input that gave them; `size_px` if not given.

        Raises
        ------
        ModelError
            If the shape matches no supported layout.
        """
        kind = row_kind(
            shape,
            classes=len(self.names),
            extra=self.extra,
            input_px=input_px or self.size_px,
            end_to_end=self.end_to_end,
        )
        if kind is not None:
            return kind
        raise ModelError(
            f"the output {shape[0]}x{shape[1]} is no {self.task} head of {len(self.names)} classes",
            source=self.source,
            remedy="export it with Ultralytics, or from YOLOv5 or YOLOv7, without changes; other "
            "detectors take part from Python, as a function that returns instances",
        )


def _read_layout(network: Network) -> YoloLayout:
    """Read the layout of a network's inputs and outputs.

    Parameters
    ----------
    network : Network
        The network; Ultralytics' metadata is used if present.

    Returns
    -------
    YoloLayout

    Raises
    ------
    ModelError
        If this is not a YOLO network of a known task with batch size 1.
    """
    source, data = network.source, network.metadata
    free_size, size = _input_size(network)
    rows = [o for o in network.outputs if len(o.shape) == 3]
    prototypes = [o for o in network.outputs if len(o.shape) == 4]
    task = data.get("task", "segment" if prototypes else "detect")
    if task not in _TASKS:
        raise ModelError(f"its task is {task!r}", source=source, remedy=_REMEDY)
    if len(rows) != 1 or len(prototypes) != (task == "segment"):
        shapes = ", ".join(f"{o.name} {_shape(o)}" for o in network.outputs)
        raise ModelError(f"its outputs are {shapes}", source=source, remedy=_REMEDY)
    keypoints = _pair(data, "kpt_shape", (0, 0), source) if task == "pose" else (0, 0)
    layout = YoloLayout(
        task=task,
        names=_names(data, source),
        input_name=network.inputs[0].name,
        rows_name=rows[0].name,
        prototypes_name=prototypes[0].name if prototypes else "",
        size_px=size,
        sizes_px=_own_sizes(data, source),
        free_size=free_size,
        stride_px=_stride(data, source),
        extra=int(prototypes[0].shape[1] or 32) if prototypes else keypoints[0] * keypoints[1],
        keypoints=keypoints,
        end_to_end=bool(
            _literal(data, "end2end", False, source)
            or _literal(data, "args", {}, source).get("nms")
        ),
        one_to_one=data.get(ONE_TO_ONE_KEY) == "True",
        by_place=data.get(ORDER_KEY) == BY_PLACE,
        source=source,
    )
    _, channels, last = rows[0].shape
    if channels is not None and last is not None:
        layout.rows_of((channels, last))
    return layout


def _input_size(network: Network) -> tuple[bool, tuple[int, int]]:
    """Return whether the input size is free, and the size (or the file's recommended one)."""
    source, inputs = network.source, network.inputs
    shape = inputs[0].shape if len(inputs) == 1 else ()
    if len(shape) != 4 or shape[1] not in (3, None):
        shapes = ", ".join(f"{i.name} {_shape(i)}" for i in inputs)
        raise ModelError(f"its inputs are {shapes}", source=source, remedy=_REMEDY)
    batch, _, height, width = shape
    if batch not in (1, None):
        raise ModelError(
            f"it takes {batch} pictures at once", source=source, remedy="export it with batch=1"
        )
    if height is not None and width is not None:
        return False, (height, width)
    default = (_DEFAULT_SIZE_PX, _DEFAULT_SIZE_PX)
    return True, _pair(network.metadata, "imgsz", default, source)


def _own_sizes(data: Mapping[str, str], source: str) -> tuple[int, ...]:
    try:
        return parse_input_sizes(data.get(SIZES_KEY, ""))
    except CucumberVisionError as error:
        raise _bad_metadata(data, SIZES_KEY, source) from error


def _shape(info: TensorInfo) -> str:
    return "x".join("?" if n is None else str(n) for n in info.shape)


def _literal(data: Mapping[str, str], key: str, default: Any, source: str) -> Any:
    """Read a value that Ultralytics wrote with `str()`."""
    try:
        return ast.literal_eval(data[key]) if key in data else default
    except (ValueError, SyntaxError) as error:
        raise _bad_metadata(data, key, source) from error


def _pair(
    data: Mapping[str, str], key: str, default: tuple[int, int], source: str
) -> tuple[int, int]:
    value = _literal(data, key, default, source)
    if (
        not isinstance(value, (list, tuple))
        or len(value) != 2
        or not all(isinstance(n, int) and n > 0 for n in value)
    ):
        raise _bad_metadata(data, key, source)
    return value[0], value[1]


def _stride(data: Mapping[str, str], source: str) -> int:
    value = _literal(data, "stride", _DEFAULT_STRIDE_PX, source)
    if not isinstance(value, int | float) or not 1 <= value <= _LARGEST_STRIDE_PX or value % 1:
        raise _bad_metadata(data, "stride", source)
    return int(value)


def _names(data: Mapping[str, str], source: str) -> dict[int, str]:
    value = _literal(data, "names", {}, source)
    if isinstance(value, (list, tuple)):
        return {i: str(name) for i, name in enumerate(value)}
    if not isinstance(value, dict):
        raise _bad_metadata(data, "names", source)
    try:
        return {int(i): str(name) for i, name in value.items()}
    except (TypeError, ValueError, OverflowError) as error:
        raise _bad_metadata(data, "names", source) from error


def _bad_metadata(data: Mapping[str, str], key: str, source: str) -> ModelError:
    return ModelError(
        f"its {key!r} is {data.get(key, 'missing')[:60]!r}", source=source, remedy="export it again"
    )


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
    verified : bool
        As for `open_network`.

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
        *,
        verified: bool = False,
    ) -> None:
        self._network = (
            path
            if isinstance(path, Network)
            else open_network(path, runtime, full_precision=full_precision, verified=verified)
        )
        self._most_fruit = most_fruit
        self._layout = _read_layout(self._network)
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
        """Find fruit in one picture, at every input size; every second one sees the mirror image.

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
        # Mistakes on a mirror image are independent, those at another size often are not.
        by_size = [
            self._detect_mirrored(color_rgb, size_px, least_confidence)
            if number % 2
            else self._detect_at(color_rgb, size_px, least_confidence)
            for number, size_px in enumerate(self._sizes_px)
        ]
        merged = merge_sizes(by_size)[: self._most_fruit]
        detections = tuple(detection for detection in merged if detection.confidence > confidence)
        if not self._layout.by_place:
            return detections
        return tuple(replace(detection, end_confidence=0.5) for detection in detections)

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

    def _detect_mirrored(
        self, color_rgb: NDArray[np.uint8], size_px: tuple[int, int], confidence: float
    ) -> tuple[Instance, ...]:
        import cv2

        flipped = np.asarray(cv2.flip(color_rgb, 1), np.uint8)  # a tenth of NumPy's time
        detections = self._detect_at(flipped, size_px, confidence)
        return tuple(mirrored(detection, color_rgb.shape[1]) for detection in detections)

    def _detect_at(
        self, color_rgb: NDArray[np.uint8], size_px: tuple[int, int], confidence: float
    ) -> tuple[Instance, ...]:
        layout = self._layout
        height, width = color_rgb.shape[:2]
        box = fit(height, width, size_px, minimal=layout.free_size, stride=layout.stride_px)
        kept = [layout.prototypes_name] if layout.prototypes_name else []
        outputs = self._network.run({layout.input_name: box.as_input(color_rgb)}, kept)
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
        self,
        rows: NDArray[np.float32],
        prototypes: NDArray[np.float32] | CardArray | None,
        box: Letterbox,
    ) -> tuple[Instance, ...]:
        boxes = box.boxes_back(rows[:, :4])
        grids = self._grids(rows[:, 6:], prototypes)
        instances = []
        for row, edges, grid in zip(rows, boxes, grids, strict=True):
            if edges[2] <= edges[0] or edges[3] <= edges[1]:
                continue
            label = int(row[5])
            instance = Instance(
                box=edges, confidence=float(row[4]), class_name=self.names.get(label, str(label))
            )
            if grid is not None:
                mask = box.mask_back(*grid, edges)
                instance = replace(instance, detector_mask=mask if mask.any() else None)
            elif self._layout.keypoints[0] == _KEYPOINTS:
                instance = replace(instance, keypoints=self._keypoints(row[6:], box))
            instances.append(instance)
        return tuple(instances)

    def _grids(
        self,
        coefficients: NDArray[np.float32],
        prototypes: NDArray[np.float32] | CardArray | None,
    ) -> list[tuple[NDArray[np.float32], NDArray[np.float32]] | None]:
        """Return prototypes and their weights for each mask; on a card they are summed already."""
        if prototypes is None:
            return [None] * len(coefficients)
        if not isinstance(prototypes, CardArray):
            return [(prototypes[0], weights) for weights in coefficients]
        sums = self._network.mixed(self._layout.prototypes_name, prototypes, coefficients)
        return [(grid[None], np.ones(1, np.float32)) for grid in sums]

    def _keypoints(self, values: NDArray[np.float32], box: Letterbox) -> NDArray[np.float64]:
        points = values.reshape(self._layout.keypoints)
        visibility = points[:, 2:3] if points.shape[1] > 2 else np.ones((_KEYPOINTS, 1))
        return np.column_stack([box.points_back(points[:, :2]), visibility])
