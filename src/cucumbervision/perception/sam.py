"""The SAM family behind one interface: a mask for every prompted fruit of a picture.

The encoder runs once a picture; the decoder takes the prompts of all its fruit together. Sources:
SAM (Kirillov et al. 2023, "Segment Anything") and MobileSAM (Zhang et al. 2023, "Faster Segment
Anything").
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.perception.boxes import box_iou
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask, mask_ious

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    _Answer = tuple[NDArray[np.float32], NDArray[np.float32]]

__all__ = [
    "MIN_AGREEMENT",
    "MIN_BOX_IOU",
    "MIN_MASK_PX",
    "PROMPTS",
    "SIDE",
    "Segmenter",
    "mask_fault",
    "mask_from_logits",
    "mask_to_sam",
    "points_to_sam",
    "prepare_picture",
    "rows_needed",
    "scaled_size",
]

SIDE = 1024

"""Side of the square that SAM sees, in pixels."""

_LOW = 256

_PATCH = 16

_MEAN = np.array([123.675, 116.28, 103.53], np.float32)

_STD = np.array([58.395, 57.12, 57.375], np.float32)


def scaled_size(height: int, width: int) -> tuple[int, int]:
    """Return the height and width of a picture whose longer side is scaled to 1024.

    Examples
    --------
    >>> scaled_size(720, 1280), scaled_size(640, 480)
    ((576, 1024), (1024, 768))
    """
    scale = SIDE / max(height, width)
    return max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))


def rows_needed(height: int, width: int) -> int:
    """Return how many of the square's 1024 rows a picture reaches, in whole patches of 16.

    Below them there is only padding, which an encoder of free height need not see.

    Examples
    --------
    >>> rows_needed(720, 1280), rows_needed(480, 848), rows_needed(640, 480)
    (576, 592, 1024)
    """
    return -(-scaled_size(height, width)[0] // _PATCH) * _PATCH


def prepare_picture(color_rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Scale, normalise and pad a picture as SAM's encoder expects it.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        Red, green, blue.

    Returns
    -------
    ndarray of float32, shape (1, 3, 1024, 1024)
        Less the mean colour, divided by its spread; zero to the right and below.

    Examples
    --------
    >>> picture = prepare_picture(np.full((9, 16, 3), 255, np.uint8))
    >>> picture.shape, round(float(picture[0, 0, 575, 0]), 3), float(picture[0, 0, 576, 0])
    ((1, 3, 1024, 1024), 2.249, 0.0)
    """
    height, width = scaled_size(*color_rgb.shape[:2])
    square = np.zeros((1, 3, SIDE, SIDE), np.float32)
    for channel, plane in enumerate(_scaled_planes(color_rgb, height, width)):
        inside = square[0, channel, :height, :width]
        np.subtract(plane, _MEAN[channel], out=inside)
        inside /= _STD[channel]
    return square


def points_to_sam(points_px: NDArray[np.float64], height: int, width: int) -> NDArray[np.float32]:
    """Carry points of the picture into the decoder's pixels.

    The picture's edges run from -0.5 to W - 0.5 and are scaled onto 0 to the scaled width; the
    decoder counts pixel centres too and adds half a pixel itself.

    Parameters
    ----------
    points_px : ndarray of float64, shape (..., 2)
        u, v with (0, 0) the centre of the upper left pixel.
    height, width : int
        The picture's size.

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
    scaled: NDArray[np.float32] = ((points_px + 0.5) * scale - 0.5).astype(np.float32)
    return scaled


def mask_from_logits(logits: NDArray[np.float32], height: int, width: int) -> NDArray[np.bool_]:
    """Enlarge one low-resolution mask to the picture and cut it at zero.

    The same as SAM's own two bilinear steps (to 1024, without the padding to the picture), which
    are linear and act on rows and columns apart; done only where a positive logit can reach.

    Parameters
    ----------
    logits : ndarray of float32, shape (256, 256) or fewer rows
        One mask of the decoder; rows that it lacks are padding.
    height, width : int
        The picture's size.

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
    mask = np.zeros((height, width), bool)
    if len(logits) < _LOW:
        # The picture's lowest rows lean on the first one beyond.
        logits = np.pad(logits, ((0, _LOW - len(logits)), (0, 0)), mode="edge")
    positive = logits > 0
    if not positive.any():
        return mask
    scaled_height, scaled_width = scaled_size(height, width)
    down = _enlarging(scaled_height, height)
    across = _enlarging(scaled_width, width)
    rows = _span(down @ positive.any(axis=1) > 0)
    columns = _span(across @ positive.any(axis=0) > 0)
    if rows.stop == 0 or columns.stop == 0:
        return mask
    down, across = down[rows], across[columns]
    low_rows, low_columns = _span(down.max(axis=0) > 0), _span(across.max(axis=0) > 0)
    fine = down[:, low_rows] @ logits[low_rows, low_columns] @ across[:, low_columns].T
    mask[rows, columns] = fine > 0
    return mask


def mask_to_sam(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Shrink a mask of the picture to the decoder's pixels.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        In the picture.
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
    import cv2

    scaled_height, scaled_width = scaled_size(*mask.shape)
    rows, columns = (max(round(n * _LOW / SIDE), 1) for n in (scaled_height, scaled_width))
    part = cv2.resize(mask.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    small = np.zeros(shape, bool)
    small[:rows, :columns] = part[: shape[0], : shape[1]] > 0.5
    return small


def _span(flags: NDArray[np.bool_]) -> slice:
    """Return the slice from the first to the last set flag; slice(0, 0) if there is none."""
    found = np.flatnonzero(flags)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 0)


@lru_cache(maxsize=8)
def _enlarging(scaled: int, size: int) -> NDArray[np.float32]:
    """Return the weights, shape (size, 256), of both bilinear steps along one axis."""
    weights = _bilinear(scaled, size) @ _bilinear(_LOW, SIDE)[:scaled]
    return weights.astype(np.float32)


def _bilinear(size_in: int, size_out: int) -> NDArray[np.float64]:
    """Return the weights of a bilinear step (torch's, align_corners false), (size_out, size_in)."""
    place = np.maximum((np.arange(size_out) + 0.5) * size_in / size_out - 0.5, 0)
    first = np.minimum(place.astype(int), size_in - 1)
    share = place - first
    weights = np.zeros((size_out, size_in))
    rows = np.arange(size_out)
    weights[rows, first] += 1 - share
    weights[rows, np.minimum(first + 1, size_in - 1)] += share
    return weights


def _scaled_planes(
    color_rgb: NDArray[np.uint8], height: int, width: int
) -> list[NDArray[np.float32]]:
    """Return the colours' planes (height, width), in whole levels.

    Resized as Pillow does, which SAM was trained with: bilinear, and smoothing when it shrinks.
    """
    import cv2

    before_height, before_width = color_rgb.shape[:2]
    picture = np.ascontiguousarray(color_rgb)
    if max(before_height, before_width) <= SIDE:
        enlarged = cv2.resize(picture, (width, height), interpolation=cv2.INTER_LINEAR)
        return [np.asarray(plane, np.float32) for plane in cv2.split(enlarged)]
    # As Pillow: along the rows first, whole levels in between.
    across, down = _shrinking(before_width, width), _shrinking(before_height, height)
    columns = [np.asarray(cv2.transpose(plane), np.float32) for plane in cv2.split(picture)]
    narrow = [cv2.transpose(np.rint(across @ plane)) for plane in columns]
    return [np.rint(down @ plane) for plane in narrow]


@lru_cache(maxsize=8)
def _shrinking(size_in: int, size_out: int) -> csr_array[Any, tuple[int, int]]:
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
    kept = weights > 0
    return csr_array(
        (weights[kept].astype(np.float32), (rows[kept], columns[kept])), (size_out, size_in)
    )


PROMPTS = ("box", "box+point", "point")

"""What a detection can be prompted by: its box, its centre, or both."""

MIN_MASK_PX = 100

MIN_BOX_IOU = 0.5

MIN_AGREEMENT = 0.6

"""Least IoU with the detector's own mask, where there is one, that a mask is taken with."""

_TOGETHER = 4  # prompts in one call of the decoder: more would only need more memory

_PADDING, _FOREGROUND, _CORNER_1, _CORNER_2 = -1, 1, 2, 3


class Segmenter:
    """A SAM network ready to draw masks.

    Parameters
    ----------
    model : str or pair of Path
        A name of the registry ('mobile-sam', 'sam-vit-b'), or an encoder's and a decoder's ONNX
        file as `cucumbervision_lab.training.export_sam` writes them.
    runtime : str
        As in `cucumbervision.perception.runtime.open_network`.
    prompt : str
        One of `PROMPTS`.
    full_precision : bool
        Compute in float32 where results must reproduce.

    Raises
    ------
    ModelError
        If the prompt is unknown or a file cannot be loaded.
    UnknownModelError, ModelHashError
        From the registry.

    Examples
    --------
    >>> picture = np.full((120, 160, 3), (120, 80, 50), np.uint8)
    >>> picture[40:80, 30:130] = (40, 140, 50)
    >>> fruit = Instance(np.array([29.5, 39.5, 129.5, 79.5]))
    >>> found, = Segmenter("mobile-sam").segment(picture, [fruit])
    >>> found.mask_source.value, found.mask[60, 80], found.mask[100, 80]
    ('sam', np.True_, np.False_)
    """

    def __init__(
        self,
        model: str | tuple[Path, Path] = "mobile-sam",
        runtime: str = "auto",
        prompt: str = "box+point",
        full_precision: bool = False,
    ) -> None:
        from cucumbervision.perception.runtime import open_network

        if prompt not in PROMPTS:
            raise ModelError(
                f"no prompt is called {prompt!r}", remedy=f"choose one of {', '.join(PROMPTS)}"
            )
        if isinstance(model, str):
            from cucumbervision.perception.registry import load_registry

            files = load_registry().resolve(model)
            encoder, decoder = files["encoder"], files["decoder"]
        else:
            encoder, decoder = model
        self.prompt = prompt
        self._encoder = open_network(encoder, runtime, full_precision=full_precision)
        # The decoder takes coordinates: in bfloat16 they are off by pixels, and one mask in
        # twenty changes. In float32 ONNX Runtime is the faster one.
        self._decoder = open_network(
            decoder, "onnxruntime" if runtime == "auto" else runtime, full_precision=True
        )

    @property
    def runtime(self) -> str:
        """What runs the encoder, with the precision."""
        return self._encoder.runtime

    def segment(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
    ) -> tuple[Instance, ...]:
        """Draw a mask for each fruit.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture; red first.
        instances : sequence of Instance
            Whose boxes are the prompts.

        Returns
        -------
        tuple of Instance
            In the same order. `mask` is SAM's, or None with `mask_failure` set; the rest stays.

        Notes
        -----
        SAM gives several masks, each with the IoU that it expects. Where the detector drew a mask,
        the sum of that and the IoU with the detector's decides; else it alone.
        """
        height, width = color_rgb.shape[:2]
        boxes = [_clip(instance.box, height, width) for instance in instances]
        seen = {i: box for i, box in enumerate(boxes) if box is not None}
        answers = self._answers(
            color_rgb, np.array(list(seen.values())).reshape(-1, 4), self.prompt
        )
        given = dict(zip(seen, answers, strict=True))
        return tuple(
            _with_mask(instance, given[i], seen[i], height, width)
            if i in given
            else _without_mask(instance, "mask-empty")
            for i, instance in enumerate(instances)
        )

    def mask_at(self, color_rgb: NDArray[np.uint8], u_px: float, v_px: float) -> NDArray[np.bool_]:
        """Draw the mask of what lies at one pixel, whatever `prompt` says.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture; red first.
        u_px, v_px : float
            The pixel that somebody pointed at.

        Returns
        -------
        ndarray of bool, shape (H, W)
            May be empty.
        """
        at = np.array([[u_px, v_px, u_px, v_px]], np.float64)
        ((logits, sure),) = self._answers(color_rgb, at, "point")
        return mask_from_logits(logits[sure.argmax()], *color_rgb.shape[:2])

    def _answers(
        self, color_rgb: NDArray[np.uint8], boxes: NDArray[np.float64], prompt: str
    ) -> list[_Answer]:
        """Return each box's masks as logits, and how good SAM believes each to be."""
        if not len(boxes):
            return []
        height, width = color_rgb.shape[:2]
        picture = prepare_picture(color_rgb)
        if self._encoder.inputs[0].shape[2] is None:
            # Padding is 44 % of the square under a picture of 16:9.
            picture = picture[:, :, : rows_needed(height, width)]
        embedding = self._encoder.run({"image": picture})["embedding"]
        found: list[_Answer] = []
        for start in range(0, len(boxes), _TOGETHER):
            points, labels = _prompts(boxes[start : start + _TOGETHER], prompt)
            places = points_to_sam(points, height, width)
            answer = self._decoder.run({"embedding": embedding, "points": places, "labels": labels})
            found.extend(zip(answer["logits"], answer["ious"], strict=True))
        return found


def mask_fault(mask: NDArray[np.bool_], box: NDArray[np.float64]) -> str:
    """Return why a mask cannot be the fruit in a box; nothing if it can.

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
    >>> mask_fault(mask, box)
    'mask-empty'
    >>> mask[10:12, 10:30] = True
    >>> mask_fault(mask, box)
    'mask-small'
    >>> mask[10:16, 10:30] = True
    >>> mask_fault(mask, box)
    'mask-off-box'
    >>> mask[10:24, 10:30] = True
    >>> mask_fault(mask, box)
    ''
    """
    area = np.count_nonzero(mask)
    if not area:
        return "mask-empty"
    if area < MIN_MASK_PX:
        return "mask-small"
    return "" if box_iou(box_of_mask(mask), box) >= MIN_BOX_IOU else "mask-off-box"


def _clip(box: NDArray[np.float64], height: int, width: int) -> NDArray[np.float64] | None:
    """Cut a box to the picture; None if nothing of it is inside."""
    limit = np.array([width, height, width, height]) - 0.5
    cut = np.clip(np.asarray(box, np.float64), -0.5, limit)
    return cut if cut[2] > cut[0] and cut[3] > cut[1] else None


def _prompts(
    boxes: NDArray[np.float64], prompt: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points (N, P, 2) in pixels and SAM's labels (N, P).

    As SAM itself does, points come before the corners, and a point without a box is followed by
    an empty one.
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
    """Take the best of SAM's masks, unless it cannot be the fruit."""
    logits, sure = answer
    agreement = np.ones(len(sure))
    own = instance.detector_mask
    if own is not None and own.any():
        agreement = mask_ious(logits > 0, mask_to_sam(own, logits.shape[1:]))
    best = int((sure + agreement).argmax())
    mask = mask_from_logits(logits[best], height, width)
    fault = mask_fault(mask, box)
    if not fault and agreement[best] < MIN_AGREEMENT:
        fault = "mask-off-detector"
    if fault:
        return _without_mask(instance, fault)
    return replace(instance, mask=mask, mask_source=MaskSource.SAM, mask_failure="")


def _without_mask(instance: Instance, fault: str) -> Instance:
    return replace(instance, mask=None, mask_source=None, mask_failure=fault)
