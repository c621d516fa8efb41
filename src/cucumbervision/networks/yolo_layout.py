"""The inputs and outputs of a YOLO network: read from its metadata and shapes, and decoded."""

from __future__ import annotations

import ast
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, PositiveInt

from cucumbervision.errors import ModelError, as_errors_of
from cucumbervision.files import parse_model
from cucumbervision.fruit.masks import suppress
from cucumbervision.networks.confidence import parse_input_sizes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from cucumbervision.networks.runtime import Network, TensorInfo

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


def read_layout(network: Network) -> YoloLayout:
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
    size = _input_size(network)
    rows = [o for o in network.outputs if len(o.shape) == 3]
    prototypes = [o for o in network.outputs if len(o.shape) == 4]
    task = data.get("task", "segment" if prototypes else "detect")
    if task not in _TASKS:
        raise ModelError(f"its task is {task!r}", source=source, remedy=_REMEDY)
    if len(rows) != 1 or len(prototypes) != (task == "segment"):
        shapes = ", ".join(f"{o.name} {_shape(o)}" for o in network.outputs)
        raise ModelError(f"its outputs are {shapes}", source=source, remedy=_REMEDY)
    values = {key: _literal(data[key]) for key in _Metadata.__annotations__ if key in data}
    given = parse_model(
        _Metadata, values, source=source, error=ModelError, remedy="export it again"
    )
    keypoints = given.kpt_shape if task == "pose" else (0, 0)
    with as_errors_of(source):
        sizes_px = parse_input_sizes(data.get(SIZES_KEY, ""))
    layout = YoloLayout(
        task=task,
        names=given.names,
        input_name=network.inputs[0].name,
        rows_name=rows[0].name,
        prototypes_name=prototypes[0].name if prototypes else "",
        size_px=size or given.imgsz,
        sizes_px=sizes_px,
        free_size=size is None,
        stride_px=given.stride,
        extra=int(prototypes[0].shape[1] or 32) if prototypes else keypoints[0] * keypoints[1],
        keypoints=keypoints,
        end_to_end=given.end2end or bool(given.args.get("nms")),
        one_to_one=data.get(ONE_TO_ONE_KEY) == "True",
        by_place=data.get(ORDER_KEY) == BY_PLACE,
        source=source,
    )
    _, channels, last = rows[0].shape
    if channels is not None and last is not None:
        layout.rows_of((channels, last))
    return layout


def _input_size(network: Network) -> tuple[int, int] | None:
    """Return height and width of the input; None if they are free."""
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
    return None if height is None or width is None else (height, width)


def _shape(info: TensorInfo) -> str:
    return "x".join("?" if n is None else str(n) for n in info.shape)


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
