"""SAM networks: a mask for each prompted fruit of an image.

The encoder runs once per image, even if its fruit come in several calls with other images
between; the decoder takes several prompts at once. Sources: SAM (Kirillov et al. 2023, "Segment
Anything"; `ResizeLongestSide` and `postprocess_masks` of its code) and MobileSAM (Zhang et al.
2023, "Faster Segment Anything").
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.arrays import Array, Array32, Mask, Pixels
from cucumbervision.errors import ModelError
from cucumbervision.fruit import masks as mask_tools
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.networks.runtime import input_planes, open_network, runtime_for_batches
from cucumbervision.tube.compiled import OneThread

_Answer = tuple[Array32, Array32]

PROMPTS = ("box", "box+point", "point")
"""Prompts for a detection: its box, its centre, or both."""

_MIN_MASK_PX = 100

_MIN_BOX_IOU = 0.5

_MIN_AGREEMENT = 0.6
"""Least IoU of a mask with the detector's own, if there is one."""

_MIN_INSIDE, _MIN_SPAN = 0.9, 0.8
"""A smaller mask also agrees if this share of it is inside the detector's mask and its box is at
least this share as long: the detector's masks are too wide before leaves of the same colour."""

_LEAST_PART = 0.1
"""Least share of the detector's mask for a part to be segmented separately."""

_HELD = 4  # images whose embeddings are held, 4 MB each

_TOGETHER = 4  # prompts per call of the decoder; more need more memory and save no time

_SIDE = 1024
"""Side of the square that SAM sees, in pixels."""

_LOW = 256  # side of the masks that SAM's decoder gives
_PATCH = 16
_MEAN = (123.675, 116.28, 103.53)
_STD = (58.395, 57.12, 57.375)

_PADDING, _FOREGROUND, _CORNER_1, _CORNER_2 = -1, 1, 2, 3


class Sam:
    """A SAM network; the `Segmenter` that the registry's `mobile-sam` uses.

    Parameters
    ----------
    files : mapping of str to Path
        The ONNX files 'encoder' and 'decoder'. The encoder maps `image`, float32 (1, 3, rows,
        1024), to `embedding`; the decoder maps it with `points`, float32 (N, P, 2), and `labels`,
        int64 (N, P), to `logits`, float32 (N, 3, 256, 256), and `ious`, float32 (N, 3).
    runtime : str
        As in `cucumbervision.networks.runtime.open_network`.
    prompt : str
        One of `PROMPTS`.
    full_precision : bool
        Compute in float32 for reproducible results.

    Raises
    ------
    ModelError
        If the prompt is unknown or a file cannot be loaded.
    """

    def __init__(
        self,
        files: Mapping[str, Path],
        runtime: str = "auto",
        prompt: str = "box+point",
        *,
        full_precision: bool = False,
    ) -> None:
        if prompt not in PROMPTS:
            raise ModelError(
                f"no prompt is called {prompt!r}", remedy=f"choose one of {', '.join(PROMPTS)}"
            )
        self.prompt = prompt
        self._encoder = open_network(files["encoder"], runtime, full_precision=full_precision)
        # The decoder takes coordinates: in bfloat16 they are off by pixels, and one mask in
        # twenty changes. In float32 ONNX Runtime is the faster one.
        self._decoder = open_network(
            files["decoder"], runtime_for_batches(runtime), full_precision=True
        )
        self.runtime = self._encoder.runtime
        self._encoded: OrderedDict[object, Array32] = OrderedDict()

    @OneThread()
    def segment(self, color_rgb: Pixels, instances: Sequence[Instance]) -> tuple[Instance, ...]:
        """Draw a mask for each fruit.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The image; red first.
        instances : sequence of Instance
            Their boxes are the prompts.

        Returns
        -------
        tuple of Instance
            In the same order. `mask` is SAM's, or None with `mask_failure` set; the rest stays.

        Notes
        -----
        SAM gives several masks, each with its predicted IoU. The mask with the largest predicted
        IoU is taken, plus its IoU with the detector's mask if there is one. Parts of a fruit on
        both sides of an occluder are segmented separately, since the centre of their common box is
        on the occluder. Masks do not overlap.
        """
        parts = [_parts(instance) for instance in instances]
        drawn = iter(
            self._drawn(color_rgb, [part for instance_parts in parts for part in instance_parts])
        )
        complete = [
            _union(instance, [next(drawn) for _ in instance_parts])
            for instance, instance_parts in zip(instances, parts, strict=True)
        ]
        return _disjoint(complete)

    def _drawn(self, color_rgb: Pixels, instances: Sequence[Instance]) -> tuple[Instance, ...]:
        """Draw a mask for each, ignoring separate parts."""
        height, width = color_rgb.shape[:2]
        limit = np.array([width, height, width, height]) - 0.5
        boxes = np.array([np.clip(instance.box, -0.5, limit) for instance in instances])
        answers = self._answers(color_rgb, boxes, self.prompt)
        return tuple(
            _with_mask(instance, answer, box, height, width)
            for instance, answer, box in zip(instances, answers, boxes, strict=True)
        )

    @OneThread()
    def mask_at(self, color_rgb: Pixels, u_px: float, v_px: float) -> Mask:
        """Draw the mask of the object at one pixel, regardless of `prompt`.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The image; red first.
        u_px, v_px : float
            The selected pixel.

        Returns
        -------
        ndarray of bool, shape (H, W)
            May be empty.
        """
        point_box = np.array([[u_px, v_px, u_px, v_px]], np.float64)
        ((logits, sure),) = self._answers(color_rgb, point_box, "point")
        return mask_from_logits(logits[sure.argmax()], *color_rgb.shape[:2])

    def _answers(self, color_rgb: Pixels, boxes: Array, prompt: str) -> list[_Answer]:
        """Return each box's masks as logits, with SAM's predicted IoUs."""
        if not len(boxes):
            return []
        height, width = color_rgb.shape[:2]
        embedding = self._encode(color_rgb)
        answered: list[_Answer] = []
        for start in range(0, len(boxes), _TOGETHER):
            points, labels = _prompts(boxes[start : start + _TOGETHER], prompt)
            places = points_to_sam(points, height, width)
            answer = self._decoder.run({"embedding": embedding, "points": places, "labels": labels})
            answered.extend(zip(answer["logits"], answer["ious"], strict=True))
        return answered

    def _encode(self, color_rgb: Pixels) -> Array32:
        """Return the image's embedding; the last ones are held."""
        # Compare contents, since a camera may reuse the array for the next image.
        digest = hashlib.blake2b(np.ascontiguousarray(color_rgb).data).digest()
        picture = (color_rgb.shape, digest)
        embedding = self._encoded.pop(picture, None)
        if embedding is None:
            fixed_rows = self._encoder.inputs[0].shape[2]
            # Padding is 44 % of the square under an image of 16:9.
            rows = rows_needed(*color_rgb.shape[:2]) if fixed_rows is None else fixed_rows
            embedding = self._encoder.run({"image": prepare_picture(color_rgb, rows)})["embedding"]
            while len(self._encoded) >= _HELD:
                self._encoded.popitem(last=False)
        self._encoded[picture] = embedding
        return embedding


def scaled_size(height: int, width: int) -> tuple[int, int]:
    """Return the height and width of an image whose longer side is scaled to 1024.

    Examples
    --------
    >>> scaled_size(720, 1280), scaled_size(640, 480)
    ((576, 1024), (1024, 768))
    """
    scale = _SIDE / max(height, width)
    return max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))


def rows_needed(height: int, width: int) -> int:
    """Return how many of the square's 1024 rows an image covers, rounded up to patches of 16.

    The rest is padding, which an encoder with free height can omit.

    Examples
    --------
    >>> rows_needed(720, 1280), rows_needed(480, 848), rows_needed(640, 480)
    (576, 592, 1024)
    """
    return -(-scaled_size(height, width)[0] // _PATCH) * _PATCH


def prepare_picture(color_rgb: Pixels, rows: int = _SIDE) -> Array32:
    """Scale, normalise and pad an image as SAM's encoder expects it.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        Red, green, blue.
    rows : int
        Rows of the square that the encoder takes: at least `rows_needed`.

    Returns
    -------
    ndarray of float32, shape (1, 3, rows, 1024)
        Less the mean colour, divided by its spread; zero to the right and below.

    Examples
    --------
    >>> picture = prepare_picture(np.full((9, 16, 3), 255, np.uint8))
    >>> picture.shape, round(float(picture[0, 0, 575, 0]), 3), float(picture[0, 0, 576, 0])
    ((1, 3, 1024, 1024), 2.249, 0.0)
    """
    planes = _scaled_planes(color_rgb, *scaled_size(*color_rgb.shape[:2]))
    pixels = np.stack([np.asarray(plane, np.uint8) for plane in planes], axis=-1)[None]
    return input_planes(pixels, _MEAN, _STD, (rows, _SIDE))


def _scaled_planes(color_rgb: Pixels, height: int, width: int) -> list[Array32]:
    """Return the colours' planes (height, width), in whole levels.

    Resized as Pillow does, which SAM was trained with: bilinear, and smoothing when it shrinks.
    """
    before_height, before_width = color_rgb.shape[:2]
    picture = np.ascontiguousarray(color_rgb)
    if max(before_height, before_width) <= _SIDE:
        enlarged = cv2.resize(picture, (width, height), interpolation=cv2.INTER_LINEAR)
        return [np.asarray(plane, np.float32) for plane in cv2.split(enlarged)]
    # As Pillow: along the rows first, whole levels in between.
    across, down = _shrinking(before_width, width), _shrinking(before_height, height)
    columns = [np.asarray(cv2.transpose(plane), np.float32) for plane in cv2.split(picture)]
    narrow = [cv2.transpose(np.rint(across @ plane)) for plane in columns]
    return [np.rint(down @ plane) for plane in narrow]


@lru_cache(maxsize=8)
def _shrinking(size_in: int, size_out: int) -> Any:
    """Return the weights (size_out, size_in): each row a triangle as wide as two output pixels."""
    from scipy.sparse import csr_array

    scale = size_in / size_out
    centre = (np.arange(size_out) + 0.5) * scale
    starts = np.maximum((centre - scale + 0.5).astype(int), 0)
    ends = np.minimum((centre + scale + 0.5).astype(int), size_in)
    columns = starts[:, None] + np.arange(int((ends - starts).max()))
    weights = np.maximum(1 - np.abs(columns + 0.5 - centre[:, None]) / scale, 0)
    weights[columns >= ends[:, None]] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.broadcast_to(np.arange(size_out)[:, None], columns.shape)
    is_used = weights > 0
    return csr_array(
        (weights[is_used].astype(np.float32), (rows[is_used], columns[is_used])),
        (size_out, size_in),
    )


def points_to_sam(points_px: Array, height: int, width: int) -> Array32:
    """Map points of the image to the decoder's pixels.

    The image's edges run from -0.5 to W - 0.5 and are scaled onto 0 to the scaled width; the
    decoder counts pixel centres too and adds half a pixel itself.

    Parameters
    ----------
    points_px : ndarray of float64, shape (..., 2)
        u, v with (0, 0) the centre of the upper left pixel.
    height, width : int
        The image's size.

    Returns
    -------
    ndarray of float32, shape (..., 2)
        Pixels of the 1024 square, (0, 0) the centre of its upper left one.

    Examples
    --------
    >>> points_to_sam(np.array([[-0.5, -0.5], [639.5, 359.5], [1279.5, 719.5]]), 720, 1280).tolist()
    [[-0.5, -0.5], [511.5, 287.5], [1023.5, 575.5]]
    """
    scaled_height, scaled_width = scaled_size(height, width)
    scale = np.array([scaled_width / width, scaled_height / height])
    scaled: Array32 = ((points_px + 0.5) * scale - 0.5).astype(np.float32)
    return scaled


def mask_from_logits(logits: Array32, height: int, width: int) -> Mask:
    """Enlarge one low-resolution mask to the image and threshold it at zero.

    In SAM's own two bilinear steps: to 1024, and without the padding to the image's size.

    Parameters
    ----------
    logits : ndarray of float32, shape (256, 256) or fewer rows
        One mask of the decoder; missing rows are padding.
    height, width : int
        The image's size.

    Returns
    -------
    ndarray of bool, shape (height, width)

    Examples
    --------
    >>> logits = np.full((256, 256), -1, np.float32)
    >>> logits[:, :64] = 1
    >>> mask_from_logits(logits, 1024, 1024).sum(axis=1).tolist()[:2]
    [256, 256]
    """
    # The image's lowest rows interpolate with the first padding row.
    square = np.pad(logits, ((0, _LOW - len(logits)), (0, 0)), mode="edge")
    rows, columns = scaled_size(height, width)
    fine = cv2.resize(square, (_SIDE, _SIDE), interpolation=cv2.INTER_LINEAR)[:rows, :columns]
    enlarged = cv2.resize(fine, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged > 0)


def mask_to_sam(mask: Mask, shape: tuple[int, ...]) -> Mask:
    """Shrink a mask of the image to the decoder's pixels.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        In the image.
    shape : tuple of int
        Rows and columns of the decoder's masks: 256, or fewer rows.

    Returns
    -------
    ndarray of bool, shape `shape`
        Pixels of which more than half is in the mask.

    Examples
    --------
    >>> mask = np.zeros((720, 1280), bool)
    >>> mask[:360, :640] = True
    >>> small = mask_to_sam(mask, (256, 256))
    >>> small.sum(), small[71, 127], small[72, 127]
    (np.int64(9216), np.True_, np.False_)
    """
    scaled_height, scaled_width = scaled_size(*mask.shape)
    rows, columns = (max(round(n * _LOW / _SIDE), 1) for n in (scaled_height, scaled_width))
    part = cv2.resize(mask.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    small = np.zeros(shape, bool)
    small[:rows, :columns] = part[: shape[0], : shape[1]] > 0.5
    return small


def _fault(mask: Mask, detector_mask: Mask | None, box: Array | None = None) -> str:
    """Return why a mask cannot be a fruit; empty if it can.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
    detector_mask : ndarray of bool, shape (H, W), optional
        The detector's mask of the fruit.
    box : ndarray of float64, shape (4,), optional
        x1, y1, x2, y2 of the detection.

    Returns
    -------
    str
        'mask-empty', 'mask-small' (under 100 px), 'mask-off-box' (the mask's box has an IoU
        under 0.5 with the detection's), 'mask-off-detector' or ''.

    Examples
    --------
    >>> mask = np.zeros((40, 40), bool)
    >>> box = np.array([9.5, 9.5, 29.5, 29.5])
    >>> def fault_of(rows):
    ...     mask[10 : 10 + rows, 10:30] = True
    ...     return _fault(mask, None, box)
    >>> [fault_of(rows) for rows in (0, 2, 6, 14)]
    ['mask-empty', 'mask-small', 'mask-off-box', '']
    """
    area = np.count_nonzero(mask)
    if area < _MIN_MASK_PX:
        return "mask-small" if area else "mask-empty"
    own_box, along = mask_tools.box_of_mask(mask), False
    if detector_mask is not None and detector_mask.any():
        # It may run along all of the detector's mask, inside it.
        inside = np.count_nonzero(mask & detector_mask) >= _MIN_INSIDE * area
        spans = [
            np.ptp(b.reshape(2, 2), axis=0).max()
            for b in (own_box, mask_tools.box_of_mask(detector_mask))
        ]
        along = bool(inside and spans[0] >= _MIN_SPAN * spans[1])
        agrees = along or mask_tools.mask_iou(detector_mask, mask) >= _MIN_AGREEMENT
    else:
        agrees = True
    if box is not None and mask_tools.box_iou(own_box, box) < _MIN_BOX_IOU:
        in_box = mask_tools.share_inside(own_box[None], box[None])[0] >= _MIN_INSIDE
        if not (along and in_box):
            return "mask-off-box"
    return "" if agrees else "mask-off-detector"


def _prompts(boxes: Array, prompt: str) -> tuple[Array, NDArray[np.int64]]:
    """Return points (N, P, 2) in pixels and SAM's labels (N, P).

    As in SAM, points precede the corners, and a point without a box is followed by a padding point.
    """
    corners = boxes.reshape(-1, 2, 2)
    centres = corners.mean(axis=1, keepdims=True)
    if prompt == "box":
        points, labels = corners, [_CORNER_1, _CORNER_2]
    elif prompt == "point":
        points = np.concatenate([centres, centres], axis=1)
        labels = [_FOREGROUND, _PADDING]
    else:
        points = np.concatenate([centres, corners], axis=1)
        labels = [_FOREGROUND, _CORNER_1, _CORNER_2]
    return points, np.tile(np.array(labels, np.int64), (len(boxes), 1))


def _with_mask(
    instance: Instance, answer: _Answer, box: Array, height: int, width: int
) -> Instance:
    """Return an instance with the best of SAM's masks, unless it cannot be the fruit."""
    logits, sure = answer
    agreement = np.ones(len(sure))
    detector_mask = instance.detector_mask
    if detector_mask is not None and detector_mask.any():
        agreement = mask_tools.mask_ious(logits > 0, mask_to_sam(detector_mask, logits.shape[1:]))
    mask = mask_from_logits(logits[int((sure + agreement).argmax())], height, width)
    return _with(instance, mask, _fault(mask, detector_mask, box))


def _parts(instance: Instance) -> tuple[Instance, ...]:
    """Return an instance for each part of the detector's mask, or the instance itself."""
    detector_mask = instance.detector_mask
    window = None if detector_mask is None else mask_tools.mask_window(detector_mask)
    if detector_mask is None or window is None:
        return (instance,)
    part = detector_mask[window].astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8)
    areas = np.asarray(stats)[:, cv2.CC_STAT_AREA]
    least_px = max(_MIN_MASK_PX, _LEAST_PART * areas[1:].sum())
    large = [k for k in range(1, count) if areas[k] >= least_px]
    if len(large) < 2:
        return (instance,)
    masks = [np.zeros_like(detector_mask) for _ in large]
    for mask, k in zip(masks, large, strict=True):
        mask[window] = np.asarray(labels) == k
    return tuple(
        replace(instance, box=mask_tools.box_of_mask(mask), detector_mask=mask) for mask in masks
    )


def _union(instance: Instance, drawn: Sequence[Instance]) -> Instance:
    """Return an instance with the union of its parts' masks; rejected if one of them is."""
    masks = [part.mask for part in drawn if part.mask is not None]
    fault = next((part.mask_failure for part in drawn if part.mask is None), "")
    return _with(instance, np.logical_or.reduce(masks), fault)


def _disjoint(instances: Sequence[Instance]) -> tuple[Instance, ...]:
    """Assign each pixel to one fruit; reject a mask of which too little is left."""
    masks = [instance.mask for instance in instances]
    disjoint = mask_tools.disjoint_masks(masks, [instance.confidence for instance in instances])
    out = []
    for instance, before, after in zip(instances, masks, disjoint, strict=True):
        if after is not None and after is not before:
            instance = _with(instance, after, _fault(after, instance.detector_mask))
        out.append(instance)
    return tuple(out)


def _with(instance: Instance, mask: Mask, fault: str) -> Instance:
    """Return an instance with a mask that SAM drew, or with the fault of it."""
    if fault:
        return replace(instance, mask=None, mask_source=None, mask_failure=fault)
    return replace(instance, mask=mask, mask_source=MaskSource.SAM, mask_failure="")
