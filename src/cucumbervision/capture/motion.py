"""Estimate motion between frames by sparse optical flow on downscaled grey pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_STILL_SHARE = 1 / 250  # of the width: 3 px of 848, up to which fused lengths are correct
_WIDTH_PX = 320
_CORNERS, _LEAST_CORNERS = 100, 8
_CORNER_STRENGTH = 5e-5  # twenty times the noise on a plain wall
_WEAKEST_CORNER = 0.02  # minimum corner strength relative to the strongest
_THERE_AND_BACK_PX = 0.5
_MOTION_QUANTILE = 0.9  # quantile of the corners, so that swinging or near fruit do not dominate


def moved_px(reference: NDArray[np.uint8], pictures: Sequence[NDArray[np.uint8]]) -> list[float]:
    """Return the motion between a reference frame and each other frame.

    Corners of the reference are tracked forward and backward (Lucas and Kanade).

    Parameters
    ----------
    reference : ndarray of uint8, shape (H, W, 3)
        RGB.
    pictures : sequence of ndarray of uint8, shape (H, W, 3)
        Frames of the same camera.

    Returns
    -------
    list of float
        The 90 % quantile of the corners' motion, pixels; infinity if most corners are lost, and 0
        if the picture has too few corners.

    Examples
    --------
    >>> import cv2
    >>> blots = np.random.default_rng(1).integers(0, 255, (30, 40, 3), np.uint8)
    >>> leaf = cv2.resize(blots, (640, 480))
    >>> [round(x) for x in moved_px(leaf, [leaf, np.roll(leaf, 12, axis=1)])]
    [0, 12]
    """
    import cv2

    first, scale = _small_grey(reference)
    strongest = float(np.max(cv2.cornerMinEigenVal(first, 5)))
    if strongest < _CORNER_STRENGTH:
        return [0.0] * len(pictures)
    level = max(_CORNER_STRENGTH / strongest, _WEAKEST_CORNER)
    features = cv2.goodFeaturesToTrack(first, _CORNERS, level, 5, blockSize=5)
    corners = np.asarray(features, np.float32).reshape(-1, 2)
    if len(corners) < _LEAST_CORNERS:
        return [0.0] * len(pictures)
    first = _levelled(first)
    return [
        scale * _moved(first, _levelled(_small_grey(picture)[0]), corners) for picture in pictures
    ]


def still_px(color: NDArray[np.uint8]) -> float:
    """Return the maximum motion that counts as still for this picture size, pixels.

    Examples
    --------
    >>> still_px(np.zeros((720, 1250, 3), np.uint8))
    5.0
    """
    return float(_STILL_SHARE * color.shape[1])


def _moved(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: NDArray[np.float32]
) -> float:
    import cv2

    # OpenCV writes into the last argument if it is given.
    moved, forward_status, _ = cv2.calcOpticalFlowPyrLK(
        first, second, corners, np.zeros_like(corners)
    )
    returned, backward_status, _ = cv2.calcOpticalFlowPyrLK(
        second, first, moved, np.zeros_like(corners)
    )
    same = np.linalg.norm(np.asarray(returned) - corners, axis=1) < _THERE_AND_BACK_PX
    same &= (np.ravel(forward_status) == 1) & (np.ravel(backward_status) == 1)
    if np.count_nonzero(same) < len(corners) / 2:
        return float("inf")
    by = np.linalg.norm(np.asarray(moved) - corners, axis=1)[same]
    return float(np.quantile(by, _MOTION_QUANTILE))


def _levelled(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Normalise brightness and contrast, because exposure adapts between frames."""
    off = grey - np.float32(grey.mean())
    spread = max(float(off.std()), 1.0)
    return np.asarray(np.clip(128 + off * np.float32(40 / spread), 0, 255), np.uint8)


def _small_grey(color: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """Return a downscaled grey picture and its scale factor."""
    import cv2

    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    scale = max(grey.shape[1] / _WIDTH_PX, 1.0)
    size = round(grey.shape[1] / scale), max(round(grey.shape[0] / scale), 1)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale > 1 else grey
    return np.asarray(cv2.GaussianBlur(small, (3, 3), 0), np.uint8), scale
