"""What a YOLO network takes and gives, read from its file: task, classes, sizes and layout."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import ModelError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cucumbervision.perception.runtime import Network, TensorInfo

__all__ = ["BY_PLACE", "ONE_TO_ONE_KEY", "ORDER_KEY", "YoloLayout", "read_layout"]

ONE_TO_ONE_KEY = "one2one"
"""Metadata key of our exports: 'True' where the raw head is the one-to-one one."""

ORDER_KEY = "keypoint_order"
"""Metadata key of our pose exports; without it points run from blossom to stem."""

BY_PLACE = "place"
"""Its value where points run from a fruit's lower left end to its upper right one."""

_TASKS = ("detect", "segment", "pose")
_REMEDY = "name an ONNX export of a YOLO detect, segment or pose network"
_DEFAULT_SIZE_PX = 640
_DEFAULT_STRIDE_PX = 32


@dataclass(frozen=True)
class YoloLayout:
    """How to feed a YOLO network and read its outputs.

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
    free_size : bool
        True where the network takes any size that is a multiple of the stride.
    stride_px : int
        Its largest stride.
    extra : int
        Numbers a detection beside box and classes: mask coefficients or keypoints.
    keypoints : tuple of int
        How many keypoints, and numbers each; (0, 0) unless the task is 'pose'.
    end_to_end : bool
        True where the file says that its rows are already chosen.
    one_to_one : bool
        True where a raw head's rows do not overlap.
    by_place : bool
        True where keypoints are ordered by where they lie in the picture.
    source : str
        The file, for errors.
    """

    task: str
    names: Mapping[int, str]
    input_name: str
    rows_name: str
    prototypes_name: str
    size_px: tuple[int, int]
    free_size: bool
    stride_px: int
    extra: int
    keypoints: tuple[int, int]
    end_to_end: bool
    one_to_one: bool
    by_place: bool
    source: str

    def raw_classes(self, shape: tuple[int, ...]) -> int | None:
        """Return how many classes a raw output has, or None where the output is end-to-end.

        Parameters
        ----------
        shape : tuple of int
            Of the detections' output without the batch: (a, b).

        Raises
        ------
        ModelError
            If the shape is neither layout's.
        """
        channels, last = shape
        classes = len(self.names) or channels - 4 - self.extra
        raw = classes > 0 and channels == 4 + classes + self.extra
        chosen = last == 6 + self.extra
        if chosen and (self.end_to_end or not raw or not self.names):
            return None
        if raw:
            return classes
        raise ModelError(
            f"the output {channels}x{last} is no {self.task} head of {len(self.names)} classes "
            f"({6 + self.extra} columns or {4 + classes + self.extra} rows)",
            source=self.source,
            remedy=_REMEDY,
        )


def read_layout(network: Network) -> YoloLayout:
    """Read what a network takes and gives.

    Parameters
    ----------
    network : Network
        Any network; Ultralytics' metadata is used where it is there.

    Returns
    -------
    YoloLayout

    Raises
    ------
    ModelError
        If this is no YOLO network of a known task, or not for one picture at a time.
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
        free_size=free_size,
        stride_px=int(_literal(data, "stride", _DEFAULT_STRIDE_PX, source)),
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
        layout.raw_classes((channels, last))
    return layout


def _input_size(network: Network) -> tuple[bool, tuple[int, int]]:
    """Return whether the input's size is free, and what it is (or what the file recommends)."""
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


def _names(data: Mapping[str, str], source: str) -> dict[int, str]:
    value = _literal(data, "names", {}, source)
    if isinstance(value, (list, tuple)):
        return {i: str(name) for i, name in enumerate(value)}
    if not isinstance(value, dict):
        raise _bad_metadata(data, "names", source)
    return {int(i): str(name) for i, name in value.items()}


def _bad_metadata(data: Mapping[str, str], key: str, source: str) -> ModelError:
    return ModelError(
        f"its {key!r} is {data.get(key, 'missing')[:60]!r}", source=source, remedy="export it again"
    )
