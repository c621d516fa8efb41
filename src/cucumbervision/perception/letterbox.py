"""Resize and pad a picture to a network's input, and take its answers back, exactly.

Ultralytics measures from the picture's corner (pixel i covers i to i + 1), cameras and `Instance`
from the first pixel's centre (pixel i covers i - 0.5 to i + 0.5): going back subtracts 0.5.
Source: `LetterBox`, `scale_boxes`, `scale_coords` and `process_mask_native` of Ultralytics 8.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import gcd
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Letterbox", "fit"]

_GREY = 114


@dataclass(frozen=True)
class Letterbox:
    """How a picture lies in a network's input; `fit` makes it.

    Parameters
    ----------
    height, width : int
        The picture's size in pixels.
    input_height, input_width : int
        The network input's size.
    inner_height, inner_width : int
        The resized picture's size inside it.
    top, left : int
        Grey rows above and columns to the left.

    Examples
    --------
    >>> box = fit(720, 1280, (640, 640))
    >>> (box.inner_height, box.inner_width, box.top, box.left)
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
    top: int
    left: int

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
        out[self.top : self.top + rows, self.left : self.left + columns] = inner
        return out

    def boxes_back(self, boxes: NDArray[np.floating]) -> NDArray[np.float64]:
        """Take boxes from the network's input to the picture, clipped to it.

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
        """Take points from the network's input to the picture, clipped to it.

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
        back = (np.asarray(points, np.float64) - (self.left, self.top)) / gain
        return np.clip(back, 0.0, (self.width, self.height)) - 0.5

    def mask_back(
        self,
        prototypes: NDArray[np.float32],
        coefficients: NDArray[np.float32],
        box: NDArray[np.floating],
    ) -> NDArray[np.bool_]:
        """Take one mask from the prototypes' grid to the picture, cut by its box.

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
        rows, columns = _mask_weights(self, *prototypes.shape[1:])
        (top, bottom, rows), (left, right, columns) = _used(rows[y1:y2]), _used(columns[x1:x2])
        logits = np.tensordot(coefficients, prototypes[:, top:bottom, left:right], axes=1)
        mask[y1:y2, x1:x2] = rows @ logits @ columns.T > 0
        return mask


def fit(
    height: int,
    width: int,
    size: tuple[int, int],
    *,
    minimal: bool = False,
    stride: int = 32,
) -> Letterbox:
    """Return how a picture is fitted into a network's input.

    Parameters
    ----------
    height, width : int
        The picture's size in pixels.
    size : tuple of int
        Height and width of the network's input.
    minimal : bool
        Pad only up to the next multiple of `stride`, as Ultralytics does where the network takes
        any size (`rect`).
    stride : int
        The network's largest stride in pixels.

    Returns
    -------
    Letterbox

    Examples
    --------
    >>> box = fit(720, 1280, (640, 640), minimal=True)
    >>> (box.input_height, box.input_width, box.top)
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
        top=spare_rows // 2,
        left=spare_columns // 2,
    )


@lru_cache(maxsize=8)
def _mask_weights(
    box: Letterbox, rows: int, columns: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the matrices that interpolate the prototypes' rows and columns to the picture's.

    Where the padding is no whole number of prototype pixels, the prototypes are first enlarged two
    or four times, so that it can be cut off whole.
    """
    gain = min(4 * rows / box.height, 4 * columns / box.width)
    spare_rows = 4 * rows - max(round(box.height * gain), 1)
    spare_columns = 4 * columns - max(round(box.width * gain), 1)
    spare = spare_rows | spare_columns
    enlarge = 4 // gcd(4, spare | spare // 2)
    gain = min(enlarge * rows / box.height, enlarge * columns / box.width)
    return (
        _side_weights(rows, enlarge, box.height, gain),
        _side_weights(columns, enlarge, box.width, gain),
    )


def _used(weights: NDArray[np.float32]) -> tuple[int, int, NDArray[np.float32]]:
    """Cut the weights to the prototype pixels that they use: first, one past the last."""
    used = np.flatnonzero(weights.any(axis=0))
    if not len(used):
        return 0, 0, weights[:, :0]
    first, end = int(used[0]), int(used[-1]) + 1
    return first, end, weights[:, first:end]


def _side_weights(size: int, enlarge: int, target: int, gain: float) -> NDArray[np.float32]:
    content = max(round(target * gain), 1)
    start = round((enlarge * size - content) / 2 - 0.1)
    enlarged = _linear_weights(size, enlarge * size)[start : start + content]
    return (_linear_weights(content, target) @ enlarged).astype(np.float32)


def _linear_weights(size: int, target: int) -> NDArray[np.float64]:
    """Return the matrix (target, size) of linear interpolation between pixel centres."""
    at = np.clip((np.arange(target) + 0.5) * size / target - 0.5, 0, size - 1)
    low = np.minimum(at.astype(int), max(size - 2, 0))
    weights = np.zeros((target, size))
    weights[np.arange(target), low] = 1 - (at - low)
    weights[np.arange(target), np.minimum(low + 1, size - 1)] += at - low
    return weights
