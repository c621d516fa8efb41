"""Resize pictures for networks, and map their outputs back exactly.

Ultralytics and SAM measure from the picture's corner (pixel i covers i to i + 1), cameras and
`Instance` from the first pixel's centre (pixel i covers i - 0.5 to i + 0.5); the way back subtracts
0.5. Sources: `LetterBox`, `scale_boxes`, `scale_coords` and `process_mask_native` of Ultralytics
8.4; `ResizeLongestSide` and `postprocess_masks` of SAM.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from numpy.typing import ArrayLike, NDArray
    from scipy.sparse import csr_array

_SIDE = 1024
"""Side of the square that SAM sees, in pixels."""

_LOW = 256  # side of the masks that SAM's decoder gives
_PATCH = 16
_MEAN = (123.675, 116.28, 103.53)
_STD = (58.395, 57.12, 57.375)
_GREY = 114


def input_planes(
    pixels: NDArray[np.uint8],
    mean: Sequence[float] = (0.0,),
    scale: Sequence[float] = (255.0,),
    size_px: tuple[int, int] | None = None,
) -> NDArray[np.float32]:
    """Return pictures as an input that takes (level - mean) / scale by planes.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (N, H, W, C)
        The pictures.
    mean, scale : sequence of float
        One of each per channel, or one for all.
    size_px : tuple of int, optional
        Height and width of the input; zeros fill it to the right and below.

    Returns
    -------
    ndarray of float32, shape (N, C, height, width)

    Examples
    --------
    >>> input_planes(np.full((1, 2, 2, 3), 51, np.uint8))[0, :, 0, 0].tolist()
    [0.20000000298023224, 0.20000000298023224, 0.20000000298023224]
    """
    import cv2

    count, rows, columns, channels = pixels.shape
    planes = np.zeros((count, channels, *(size_px or (rows, columns))), np.float32)
    means, scales = (
        np.broadcast_to(np.asarray(values, np.float32), (channels,)) for values in (mean, scale)
    )
    for picture, out in zip(pixels, planes, strict=True):
        for channel, levels in enumerate(cv2.split(picture)):
            inside = out[channel, :rows, :columns]
            # Divided, not multiplied by 1/255: the same float32 values as Ultralytics'.
            np.subtract(levels, means[channel], out=inside, dtype=np.float32)
            inside /= scales[channel]
    return planes


@dataclass(frozen=True)
class Letterbox:
    """Position of a picture in a network's input; made by `fit`.

    Parameters
    ----------
    height, width : int
        The picture's size in pixels.
    input_height, input_width : int
        The network input's size.
    inner_height, inner_width : int
        The resized picture's size inside it.
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

    def apply(self, color_rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resize linearly and pad with grey.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (height, width, 3)
            The picture.

        Returns
        -------
        ndarray of uint8, shape (input_height, input_width, 3)
        """
        import cv2

        size = self.inner_width, self.inner_height
        inner = cv2.resize(color_rgb, size, interpolation=cv2.INTER_LINEAR)
        out = np.full((self.input_height, self.input_width, 3), _GREY, np.uint8)
        rows, columns = self.inner_height, self.inner_width
        out[self.top_px : self.top_px + rows, self.left_px : self.left_px + columns] = inner
        return out

    def as_input(self, color_rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the input (1, 3, input_height, input_width) of 0 to 1, red first."""
        return input_planes(self.apply(color_rgb)[None])

    def boxes_back(self, boxes: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map boxes from the network's input to the picture, and clip them.

        Parameters
        ----------
        boxes : ndarray, shape (N, 4)
            x1, y1, x2, y2 in the input's pixels, from its corner.

        Returns
        -------
        ndarray of float64, shape (N, 4)
            The same in the picture's pixels, from its first pixel's centre.
        """
        return self.points_back(np.reshape(boxes, (-1, 2, 2))).reshape(-1, 4)

    def points_back(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map points from the network's input to the picture, and clip them.

        Parameters
        ----------
        points : ndarray, shape (..., 2)
            u, v in the input's pixels, from its corner.

        Returns
        -------
        ndarray of float64, shape (..., 2)
            The same in the picture's pixels, from its first pixel's centre.
        """
        # Each side has its own gain, since each was rounded to whole pixels.
        gain = self.inner_width / self.width, self.inner_height / self.height
        original = (np.asarray(points, np.float64) - (self.left_px, self.top_px)) / gain
        return np.clip(original, 0.0, (self.width, self.height)) - 0.5

    def mask_back(
        self,
        prototypes: NDArray[np.float32],
        coefficients: NDArray[np.float32],
        box: NDArray[np.floating],
    ) -> NDArray[np.bool_]:
        """Map one mask from the prototypes' grid to the picture, and crop it to its box.

        The prototypes' weighted sum is interpolated linearly and cut at zero at the picture's own
        resolution (`process_mask_native`, Ultralytics' `retina_masks`); only the part that the
        box needs is computed.

        Parameters
        ----------
        prototypes : ndarray of float32, shape (C, h, w)
            On a grid of a quarter of the input.
        coefficients : ndarray of float32, shape (C,)
            The detection's weight of each.
        box : ndarray, shape (4,)
            x1, y1, x2, y2 in the picture's pixels, from its first pixel's centre.

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
    """Compute the position of a picture in a network's input.

    Parameters
    ----------
    height, width : int
        The picture's size in pixels.
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
def _mask_weights(
    box: Letterbox, rows: int, columns: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the matrices that interpolate the prototypes' rows and columns to the picture's."""
    return (
        _linear_weights(rows, box.input_height, box.top_px, box.inner_height, box.height),
        _linear_weights(columns, box.input_width, box.left_px, box.inner_width, box.width),
    )


def _linear_weights(
    cells: int, input_px: int, start_px: int, inner_px: int, size: int
) -> NDArray[np.float32]:
    """Return what each of `cells` along a side adds to each of `size` pixels, (size, cells).

    The picture's side lies at `start_px`, `inner_px` long, in an input of `input_px`. Cells in the
    padding add nothing.
    """
    cell = (start_px + (np.arange(size) + 0.5) * inner_px / size) * cells / input_px - 0.5
    first = np.ceil(start_px * cells / input_px)
    last = np.floor((start_px + inner_px) * cells / input_px) - 1
    cell = np.clip(cell, first, max(first, last))
    weights = np.maximum(1 - np.abs(cell[:, None] - np.arange(cells)), 0)
    return np.asarray(weights, np.float32)


def scaled_size(height: int, width: int) -> tuple[int, int]:
    """Return the height and width of a picture whose longer side is scaled to 1024.

    Examples
    --------
    >>> scaled_size(720, 1280), scaled_size(640, 480)
    ((576, 1024), (1024, 768))
    """
    scale = _SIDE / max(height, width)
    return max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))


def rows_needed(height: int, width: int) -> int:
    """Return how many of the square's 1024 rows a picture covers, rounded up to patches of 16.

    The rest is padding, which an encoder with free height can omit.

    Examples
    --------
    >>> rows_needed(720, 1280), rows_needed(480, 848), rows_needed(640, 480)
    (576, 592, 1024)
    """
    return -(-scaled_size(height, width)[0] // _PATCH) * _PATCH


def prepare_picture(color_rgb: NDArray[np.uint8], rows: int = _SIDE) -> NDArray[np.float32]:
    """Scale, normalise and pad a picture as SAM's encoder expects it.

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


def points_to_sam(points_px: NDArray[np.float64], height: int, width: int) -> NDArray[np.float32]:
    """Map points of the picture to the decoder's pixels.

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
    """Enlarge one low-resolution mask to the picture and threshold it at zero.

    In SAM's own two bilinear steps: to 1024, and without the padding to the picture's size.

    Parameters
    ----------
    logits : ndarray of float32, shape (256, 256) or fewer rows
        One mask of the decoder; missing rows are padding.
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
    import cv2

    # The picture's lowest rows interpolate with the first padding row.
    square = np.pad(logits, ((0, _LOW - len(logits)), (0, 0)), mode="edge")
    rows, columns = scaled_size(height, width)
    fine = cv2.resize(square, (_SIDE, _SIDE), interpolation=cv2.INTER_LINEAR)[:rows, :columns]
    enlarged = cv2.resize(fine, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged > 0)


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
    rows, columns = (max(round(n * _LOW / _SIDE), 1) for n in (scaled_height, scaled_width))
    part = cv2.resize(mask.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    small = np.zeros(shape, bool)
    small[:rows, :columns] = part[: shape[0], : shape[1]] > 0.5
    return small


def _span(flags: ArrayLike) -> slice:
    """Return the slice from the first to the last set flag; slice(0, 0) if there is none."""
    indices = np.flatnonzero(flags)
    return slice(int(indices[0]), int(indices[-1]) + 1) if len(indices) else slice(0, 0)


def _scaled_planes(
    color_rgb: NDArray[np.uint8], height: int, width: int
) -> list[NDArray[np.float32]]:
    """Return the colours' planes (height, width), in whole levels.

    Resized as Pillow does, which SAM was trained with: bilinear, and smoothing when it shrinks.
    """
    import cv2

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
    is_used = weights > 0
    return csr_array(
        (weights[is_used].astype(np.float32), (rows[is_used], columns[is_used])),
        (size_out, size_in),
    )
