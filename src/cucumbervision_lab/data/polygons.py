"""Lossless polygons of masks, and keypoints along a mask's axis.

The origin of polygons is the picture's corner, as in YOLO and COCO files, so the centre of the
first pixel is (0.5, 0.5); `instances.mask_codes.fill_polygon` is the inverse. Keypoints of a mask
are pseudo-labels for photos: they follow the axis of the outline, not of the body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.fruit.masks import mask_window
from cucumbervision.networks.keypoint_axis import KEYPOINT_SHARES, axis_line
from cucumbervision.tube.curve import points_along
from cucumbervision_lab.arrays import Array, Mask, Pixels

if TYPE_CHECKING:
    from collections.abc import Sequence


def _outlines(mask: Mask) -> list[Array]:
    """Return the outer outline of each part, largest first, with a point every half pixel.

    The outline runs through the midpoints of pixel edges: exactly the pixel centres of the part and
    of its holes lie inside. Pixels that touch at a corner belong to the same part.
    """
    import cv2

    window = mask_window(mask)
    if window is None:
        return []
    contours, _ = cv2.findContours(_doubled(mask[window]), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    corner = np.array([window[1].start, window[0].start], np.float64)
    parts = [contour.reshape(-1, 2) / 2 + corner for contour in contours]
    return sorted(parts, key=_area, reverse=True)


def _doubled(mask: Mask) -> Pixels:
    """Return pixel centres, edge midpoints and corners as a grid of shape (2 H + 1, 2 W + 1)."""
    height, width = mask.shape
    padded = np.zeros((height + 2, width + 2), np.uint8)
    padded[1:-1, 1:-1] = mask
    across, below = padded[:, 1:] + padded[:, :-1], padded[1:] + padded[:-1]
    grid = np.zeros((2 * height + 1, 2 * width + 1), np.uint8)
    grid[1::2, 1::2] = mask
    grid[1::2, 0::2] = across[1:-1] > 0
    grid[0::2, 1::2] = below[:, 1:-1] > 0
    # A corner that belongs to a single pixel stays outside: the outline cuts it off.
    grid[0::2, 0::2] = across[1:] + across[:-1] > 1
    return grid


def _simplified(points: Array) -> Array:
    """Remove points within straight segments.

    Reversals are kept, and so are the ends of bridges, which occur twice: otherwise two bridges
    that meet at a point could cross.
    """
    before = points - np.roll(points, 1, axis=0)
    after = np.roll(points, -1, axis=0) - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    _, which, times = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    corners = (cross != 0) | ((before * after).sum(axis=1) < 0) | (times[which.ravel()] > 1)
    straight: Array = points[corners]
    return straight


def _area(points: Array) -> float:
    x, y = points.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def join_parts(parts: Sequence[Array]) -> Array:
    """Join polygons with zero-width bridges across the shortest gaps.

    YOLO files store one polygon per fruit; Ultralytics' converters join parts in the same way.

    Parameters
    ----------
    parts : sequence of ndarray, shape (K, 2)
        At least one polygon, not nested.

    Returns
    -------
    ndarray of float64, shape (N, 2)
        The joined polygon.

    Examples
    --------
    >>> square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> join_parts([square, square + (3, 0)]).shape
    (10, 2)
    """
    from scipy.spatial import cKDTree

    joined, remaining = parts[0], list(parts[1:])
    while remaining:
        tree = cKDTree(joined)
        neighbours = [tuple(np.asarray(array) for array in tree.query(part)) for part in remaining]
        nearest = int(np.argmin([gaps.min() for gaps, _ in neighbours]))
        gaps, partner = neighbours[nearest]
        part, j = remaining.pop(nearest), int(gaps.argmin())
        i = int(partner[j])
        joined = np.concatenate([joined[: i + 1], part[j:], part[: j + 1], joined[i:]])
    return joined


def one_polygon(mask: Mask, min_part_px: float = 16.0) -> Array | None:
    """Return a mask as a single polygon without small parts.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        The mask.
    min_part_px : float
        Minimum area of a part, pixels; the largest part is always kept.

    Returns
    -------
    ndarray of float64, shape (K, 2), or None
        Polygon in pixels from the picture's corner; None for an empty mask.

    Examples
    --------
    >>> one_polygon(np.zeros((4, 6), bool)) is None
    True
    """
    parts = _outlines(mask)
    if not parts:
        return None
    # Join before simplifying: bridges between the corners of long segments could cross an outline.
    large = [p for p in parts if p is parts[0] or _area(p) >= min_part_px]
    return _simplified(join_parts(large))


DIRECTIONS = {
    "right": (1.0, 0.0),
    "left": (-1.0, 0.0),
    "down": (0.0, 1.0),
    "up": (0.0, -1.0),
    "down-right": (1.0, 1.0),
    "down-left": (-1.0, 1.0),
    "up-right": (1.0, -1.0),
    "up-left": (-1.0, -1.0),
}
"""Directions of the stem end by name, as (x, y) with y down."""


def keypoints_of_mask(mask: Mask, stem: str) -> Array | None:
    """Return keypoints along the axis of a mask.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Mask of a complete fruit.
    stem : str
        Direction of the stem end from the fruit's centre, one of `DIRECTIONS`.

    Returns
    -------
    ndarray of float64, shape (5, 3), or None
        u, v in pixels and visibility 2 of KP0 (blossom end) to KP4 (stem end), evenly spaced along
        the axis. None if the mask is too small, too round or too strongly bent, or the axis is
        nearly perpendicular to `stem`.

    Raises
    ------
    ValueError
        If `stem` is not in `DIRECTIONS`.

    Examples
    --------
    >>> mask = np.zeros((40, 100), bool)
    >>> mask[15:25, 10:91] = True
    >>> keypoints_of_mask(mask, "left")[:, 0].round().tolist()
    [90.0, 70.0, 50.0, 30.0, 10.0]
    """
    if stem not in DIRECTIONS:
        raise ValueError(f"unknown direction {stem!r}: use one of {', '.join(DIRECTIONS)}")
    line = axis_line(mask)
    if line is None:
        return None
    towards = float((line[-1] - line[0]) @ np.array(DIRECTIONS[stem]))
    norm = float(np.linalg.norm(line[-1] - line[0]) * np.linalg.norm(DIRECTIONS[stem]))
    if abs(towards) < 0.25 * norm:
        return None
    points = points_along(line if towards > 0 else line[::-1], KEYPOINT_SHARES)
    return np.column_stack([points, np.full(len(points), 2.0)])
