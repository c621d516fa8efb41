"""SAM networks: a mask for each prompted fruit of a picture.

The encoder runs once per picture, even if its fruit come in several calls with other pictures
between; the decoder takes several prompts at once. Sources: SAM (Kirillov et al. 2023, "Segment
Anything") and MobileSAM (Zhang et al. 2023, "Faster Segment Anything").
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import (
    box_iou,
    box_of_mask,
    disjoint_masks,
    mask_iou,
    mask_ious,
    mask_window,
    share_inside,
)
from cucumbervision.networks.resize import (
    mask_from_logits,
    mask_to_sam,
    points_to_sam,
    prepare_picture,
    rows_needed,
)
from cucumbervision.networks.runtime import open_network, runtime_for_batches
from cucumbervision.threads import OneThread

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    _Answer = tuple[NDArray[np.float32], NDArray[np.float32]]

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

_HELD = 4  # pictures whose embeddings are held, 4 MB each

_TOGETHER = 4  # prompts per call of the decoder; more need more memory and save no time

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
        self._encoded: OrderedDict[object, NDArray[np.float32]] = OrderedDict()

    @OneThread()
    def segment(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
    ) -> tuple[Instance, ...]:
        """Draw a mask for each fruit.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture; red first.
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

    def _drawn(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
    ) -> tuple[Instance, ...]:
        """Draw a mask for each, ignoring separate parts."""
        height, width = color_rgb.shape[:2]
        boxes = [clip_box(instance.box, height, width) for instance in instances]
        clipped = {i: box for i, box in enumerate(boxes) if box is not None}
        answers = self._answers(
            color_rgb, np.array(list(clipped.values())).reshape(-1, 4), self.prompt
        )
        by_index = dict(zip(clipped, answers, strict=True))
        return tuple(
            _with_mask(instance, by_index[i], clipped[i], height, width)
            if i in by_index
            else without_mask(instance, "mask-empty")
            for i, instance in enumerate(instances)
        )

    @OneThread()
    def mask_at(self, color_rgb: NDArray[np.uint8], u_px: float, v_px: float) -> NDArray[np.bool_]:
        """Draw the mask of the object at one pixel, regardless of `prompt`.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture; red first.
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

    def _answers(
        self, color_rgb: NDArray[np.uint8], boxes: NDArray[np.float64], prompt: str
    ) -> list[_Answer]:
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

    def _encode(self, color_rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the picture's embedding; the last ones are held."""
        # Compare contents, since a camera may reuse the array for the next picture.
        digest = hashlib.blake2b(np.ascontiguousarray(color_rgb).data).digest()
        picture = (color_rgb.shape, digest)
        embedding = self._encoded.pop(picture, None)
        if embedding is None:
            fixed_rows = self._encoder.inputs[0].shape[2]
            # Padding is 44 % of the square under a picture of 16:9.
            rows = rows_needed(*color_rgb.shape[:2]) if fixed_rows is None else fixed_rows
            embedding = self._encoder.run({"image": prepare_picture(color_rgb, rows)})["embedding"]
            while len(self._encoded) >= _HELD:
                self._encoded.popitem(last=False)
        self._encoded[picture] = embedding
        return embedding


def _mask_fault(mask: NDArray[np.bool_], box: NDArray[np.float64]) -> str:
    """Return why a mask cannot be the fruit in a box; empty if it can.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
    box : ndarray of float64, shape (4,)
        x1, y1, x2, y2 of the detection.

    Returns
    -------
    str
        'mask-empty', 'mask-small' (under 100 px), 'mask-off-box' (the mask's box has an IoU
        under 0.5 with the detection's) or ''.

    Examples
    --------
    >>> mask = np.zeros((40, 40), bool)
    >>> box = np.array([9.5, 9.5, 29.5, 29.5])
    >>> _mask_fault(mask, box)
    'mask-empty'
    >>> mask[10:12, 10:30] = True
    >>> _mask_fault(mask, box)
    'mask-small'
    >>> mask[10:16, 10:30] = True
    >>> _mask_fault(mask, box)
    'mask-off-box'
    >>> mask[10:24, 10:30] = True
    >>> _mask_fault(mask, box)
    ''
    """
    area = np.count_nonzero(mask)
    if not area:
        return "mask-empty"
    if area < _MIN_MASK_PX:
        return "mask-small"
    return "" if box_iou(box_of_mask(mask), box) >= _MIN_BOX_IOU else "mask-off-box"


def clip_box(box: NDArray[np.float64], height: int, width: int) -> NDArray[np.float64] | None:
    """Clip a box to the picture; None if it is outside."""
    limit = np.array([width, height, width, height]) - 0.5
    cut = np.clip(np.asarray(box, np.float64), -0.5, limit)
    return cut if cut[2] > cut[0] and cut[3] > cut[1] else None


def _prompts(
    boxes: NDArray[np.float64], prompt: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
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
    instance: Instance, answer: _Answer, box: NDArray[np.float64], height: int, width: int
) -> Instance:
    """Return an instance with the best of SAM's masks, unless it cannot be the fruit."""
    logits, sure = answer
    agreement = np.ones(len(sure))
    detector_mask = instance.detector_mask
    if detector_mask is not None and detector_mask.any():
        agreement = mask_ious(logits > 0, mask_to_sam(detector_mask, logits.shape[1:]))
    mask = mask_from_logits(logits[int((sure + agreement).argmax())], height, width)
    fault = _mask_fault(mask, box)
    if fault == "mask-off-box" and detector_mask is not None and detector_mask.any():
        in_box = share_inside(box_of_mask(mask)[None], box[None])[0] >= _MIN_INSIDE
        fault = "" if in_box and _runs_along_inside(mask, detector_mask) else fault
    if not fault and not _agrees(mask, detector_mask):
        fault = "mask-off-detector"
    if fault:
        return without_mask(instance, fault)
    return replace(instance, mask=mask, mask_source=MaskSource.SAM, mask_failure="")


def _parts(instance: Instance) -> tuple[Instance, ...]:
    """Return an instance for each part of the detector's mask, or the instance itself."""
    import cv2

    detector_mask = instance.detector_mask
    window = None if detector_mask is None else mask_window(detector_mask)
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
    return tuple(replace(instance, box=box_of_mask(mask), detector_mask=mask) for mask in masks)


def _union(instance: Instance, drawn: Sequence[Instance]) -> Instance:
    """Return an instance with the union of its parts' masks; rejected if one of them is."""
    masks = [part.mask for part in drawn if part.mask is not None]
    if len(masks) < len(drawn):
        fault = next(part.mask_failure for part in drawn if part.mask is None)
        return without_mask(instance, fault)
    mask = masks[0] if len(masks) == 1 else np.logical_or.reduce(masks)
    return replace(instance, mask=mask, mask_source=MaskSource.SAM, mask_failure="")


def _disjoint(instances: Sequence[Instance]) -> tuple[Instance, ...]:
    """Assign each pixel to one fruit; reject a mask of which too little is left."""
    masks = [instance.mask for instance in instances]
    disjoint = disjoint_masks(masks, [instance.confidence for instance in instances])
    out = []
    for instance, before, after in zip(instances, masks, disjoint, strict=True):
        if after is None or after is before:
            out.append(instance)
        elif np.count_nonzero(after) < _MIN_MASK_PX:
            out.append(without_mask(instance, "mask-small"))
        elif not _agrees(after, instance.detector_mask):
            out.append(without_mask(instance, "mask-off-detector"))
        else:
            out.append(replace(instance, mask=after))
    return tuple(out)


def _agrees(mask: NDArray[np.bool_], detector_mask: NDArray[np.bool_] | None) -> bool:
    if detector_mask is None or not detector_mask.any():
        return True
    return mask_iou(detector_mask, mask) >= _MIN_AGREEMENT or _runs_along_inside(
        mask, detector_mask
    )


def _runs_along_inside(mask: NDArray[np.bool_], detector_mask: NDArray[np.bool_]) -> bool:
    """Return whether a mask runs along all of the detector's, inside it."""
    inside = np.count_nonzero(mask & detector_mask) >= _MIN_INSIDE * np.count_nonzero(mask)
    box, detector_box = box_of_mask(mask), box_of_mask(detector_mask)
    spans = [max(edges[2] - edges[0], edges[3] - edges[1]) for edges in (box, detector_box)]
    return bool(inside and spans[0] >= _MIN_SPAN * spans[1])


def without_mask(instance: Instance, fault: str) -> Instance:
    """Return an instance without a mask, and why."""
    return replace(instance, mask=None, mask_source=None, mask_failure=fault)
