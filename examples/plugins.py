"""Plug-ins as another package would add them: a detector, segmenters, a method, a trait, a reader.

A package makes them known by entry points in its `pyproject.toml`:

    [project.entry-points."cucumbervision.detectors"]
    rt-detr = "plugins:RtDetr"
    [project.entry-points."cucumbervision.segmenters"]
    grabcut = "plugins:GrabCut"
    sam2 = "plugins:Sam2"
    [project.entry-points."cucumbervision.methods"]
    M7 = "plugins:BOX_DIAGONAL"
    [project.entry-points."cucumbervision.traits"]
    mean_green = "plugins:MEAN_GREEN"
    [project.entry-points."cucumbervision.readers"]
    tum = "plugins:find_tum"

Then `cucumbervision measure captures --instances rt-detr --segmenter grabcut --out run` uses them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cucumbervision import Capture, Instance, Intrinsics, LengthKind, Measurement, TableTrait
from cucumbervision.capture.pictures import read_color, read_depth
from cucumbervision.errors import IntrinsicsError
from cucumbervision.methods.table import Region, TableMethod
from cucumbervision.methods.result import Fruit, Reason

if TYPE_CHECKING:
    from cucumbervision.capture.source import CaptureLister, Folder, ReadOptions


class RtDetr:
    """An RT-DETR as Transformers exports it: `logits` (1, Q, C) and `pred_boxes` (1, Q, 4).

    The boxes are centre and size as shares of the picture. The file is that of the environment
    variable `RTDETR_ONNX`.
    """

    def __init__(self, path: str | None = None, class_id: int = 0, confidence: float = 0.5) -> None:
        path = path or os.environ["RTDETR_ONNX"]
        self._session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
        self._class_id, self._confidence = class_id, confidence

    def __call__(self, capture: Capture, /) -> list[Instance]:
        """Return the fruit of a capture, by their boxes."""
        small = cv2.resize(capture.color, (640, 640), interpolation=cv2.INTER_AREA)
        feeds = {
            self._session.get_inputs()[0].name: small.transpose(2, 0, 1)[None] / np.float32(255)
        }
        logits, boxes = self._session.run(["logits", "pred_boxes"], feeds)
        scores = 1 / (1 + np.exp(-logits[0, :, self._class_id].astype(np.float64)))
        size = np.array([capture.width, capture.height] * 2)
        half = boxes[0, :, 2:] / 2
        edges = np.hstack([boxes[0, :, :2] - half, boxes[0, :, :2] + half]) * size - 0.5
        return [
            Instance(edges[k].astype(np.float64), confidence=float(scores[k]))
            for k in np.flatnonzero(scores >= self._confidence)
        ]


class GrabCut:
    """OpenCV's GrabCut: the fruit is what differs from the colours outside its box."""

    def segment(self, color_rgb: NDArray[np.uint8], fruit: Sequence[Instance], /) -> list[Instance]:
        """Return the fruit with masks."""
        bgr = np.ascontiguousarray(color_rgb[..., ::-1])
        return [replace(instance, mask=self._mask(bgr, instance.box)) for instance in fruit]

    def _mask(self, bgr: NDArray[np.uint8], box: NDArray[np.float64]) -> NDArray[np.bool_]:
        x1, y1, x2, y2 = (round(float(edge)) for edge in box)
        labels = np.zeros(bgr.shape[:2], np.uint8)
        rectangle, models = (x1, y1, max(x2 - x1, 1), max(y2 - y1, 1)), np.zeros((2, 1, 65))
        cv2.grabCut(bgr, labels, rectangle, *models, 3, cv2.GC_INIT_WITH_RECT)
        return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))


class Sam2:
    """SAM 2 (Ravi et al. 2024; `pip install sam2`), by the variables SAM2_CONFIG and SAM2_FILE."""

    def __init__(self) -> None:
        from sam2.build_sam import build_sam2
        from sam2.sam2_image_predictor import SAM2ImagePredictor

        model = build_sam2(os.environ["SAM2_CONFIG"], os.environ["SAM2_FILE"], device="cpu")
        self._predictor = SAM2ImagePredictor(model)

    def segment(self, color_rgb: NDArray[np.uint8], fruit: Sequence[Instance], /) -> list[Instance]:
        """Return the fruit with masks; SAM 2 measures from the picture's corner."""
        self._predictor.set_image(color_rgb)
        predict = partial(self._predictor.predict, multimask_output=False)
        return [replace(one, mask=predict(box=one.box + 0.5)[0][0] > 0) for one in fruit]


def _box_diagonal(region: Region) -> Measurement:
    """Return the diagonal of the box at the fruit's median depth."""
    points = region.mask_points_m
    if points is None or not len(points):
        return Measurement("M7", reason=Reason.TOO_FEW_POINTS)
    x1, y1, x2, y2 = region.box
    depth_m = float(np.median(points[:, 2]))
    camera = region.intrinsics
    length_m = depth_m * np.hypot((x2 - x1) / camera.fx_px, (y2 - y1) / camera.fy_px)
    return Measurement("M7", float(length_m), LengthKind.BOX_CHORD)


# Without a rank the selector never chooses it: it gets its column, and lengths stay as they are.
BOX_DIAGONAL = TableMethod(
    "M7", "diagonal of the box", LengthKind.BOX_CHORD, _box_diagonal, needs=("box", "mask")
)


def _mean_green(capture: Capture, fruit: Fruit) -> float | None:
    return None if fruit.mask is None else float(capture.color[fruit.mask][:, 1].mean() / 255)


MEAN_GREEN = TableTrait("mean_green", "", "mean of the green channel, 0 to 1", _mean_green)


def find_tum(folder: Folder, /) -> CaptureLister | None:
    """Find TUM sequences: `associations.txt` with time, colour, time, depth; a step is 1/5000 m."""
    pairs = []
    for place, names in folder.files.items():
        if "associations.txt" in names:
            names.remove("associations.txt")
            text = (folder.path / place / "associations.txt").read_text()
            for _, color, _, depth in (line.split() for line in text.splitlines()):
                pairs.append([folder.path / place / color, folder.path / place / depth])
    return partial(_list_tum, pairs) if pairs else None


def _list_tum(pairs: list[list[Path]], options: ReadOptions, camera: Any) -> Iterator[Any]:
    if camera is None:
        raise IntrinsicsError("has none", source=pairs[0][0], remedy="give --intrinsics FILE")
    for number, (color, depth) in enumerate(pairs):
        load = partial(_load_tum, color, depth, camera.intrinsics, options.depth_unit_m)
        yield color.stem, number, load, color, partial(list, (color, depth, camera.path))


def _load_tum(color: Path, depth: Path, camera: Any, unit_m: float | None, name: str) -> Capture:
    unit_m, steps = unit_m or 1 / 5000, read_depth(depth)
    return Capture.from_arrays(read_color(color), steps, camera, depth_unit_m=unit_m, name=name)
