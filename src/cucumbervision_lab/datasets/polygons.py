"""Polygons of masks without losing a pixel, and keypoints along a mask's axis.

Polygons' points count from the picture's corner, as YOLO and COCO files do: the first pixel's
centre is (0.5, 0.5); `perception.masks.fill_polygon` draws them again. Keypoints of a mask are
pseudo-labels for photos whose fruit somebody only boxed: the axis is that of the outline, not of
the body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.curve import points_along
from cucumbervision.perception.keypoint_axis import SHARES, axis_line
from cucumbervision.perception.masks import mask_window

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def _traced(mask: NDArray[np.bool_]) -> list[Array]:
    """Return each part's outer outline, the largest first, with a point every half pixel.

    It runs through the middles of the pixels' edges: every pixel centre of the part lies inside,
    every other outside, holes excepted, which are filled. Pixels that touch by a corner belong
    together.
    """
    import cv2

    window = mask_window(mask)
    if window is None:
        return []
    found, _ = cv2.findContours(_doubled(mask[window]), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    corner = np.array([window[1].start, window[0].start], np.float64)
    parts = [contour.reshape(-1, 2) / 2 + corner for contour in found]
    return sorted(parts, key=_area, reverse=True)


def _doubled(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return pixel centres, edge middles and corners as one grid of (2 H + 1, 2 W + 1)."""
    height, width = mask.shape
    padded = np.zeros((height + 2, width + 2), np.uint8)
    padded[1:-1, 1:-1] = mask
    beside, below = padded[:, 1:] + padded[:, :-1], padded[1:] + padded[:-1]
    grid = np.zeros((2 * height + 1, 2 * width + 1), np.uint8)
    grid[1::2, 1::2] = mask
    grid[1::2, 0::2] = beside[1:-1] > 0
    grid[0::2, 1::2] = below[:, 1:-1] > 0
    # A corner of one pixel only stays out: the outline cuts it.
    grid[0::2, 0::2] = beside[1:] + beside[:-1] > 1
    return grid


def _straightened(points: Array) -> Array:
    """Leave out the points amid straight runs; turning back on itself is no straight run.

    Where a bridge begins or ends, which is passed twice, a point stays: two bridges that meet there
    would else go through each other.
    """
    before = points - np.roll(points, 1, axis=0)
    after = np.roll(points, -1, axis=0) - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    _, which, times = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    kept = (cross != 0) | ((before * after).sum(axis=1) < 0) | (times[which.ravel()] > 1)
    straight: Array = points[kept]
    return straight


def _area(points: Array) -> float:
    x, y = points.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def join_parts(parts: Sequence[Array]) -> Array:
    """Join polygons to one by bridges without width, each over the shortest gap that is left.

    YOLO files have one polygon a fruit; Ultralytics' converters join parts in the same way.

    Parameters
    ----------
    parts : sequence of ndarray, shape (K, 2)
        At least one; none inside another.

    Returns
    -------
    ndarray of float64, shape (N, 2)

    Examples
    --------
    >>> left = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> join_parts([left, left + (3, 0)]).shape
    (10, 2)
    """
    from scipy.spatial import cKDTree

    joined, rest = parts[0], list(parts[1:])
    while rest:
        tree = cKDTree(joined)
        found = [tuple(np.asarray(one) for one in tree.query(part)) for part in rest]
        nearest = int(np.argmin([gaps.min() for gaps, _ in found]))
        gaps, at = found[nearest]
        part, j = rest.pop(nearest), int(gaps.argmin())
        i = int(at[j])
        joined = np.concatenate([joined[: i + 1], part[j:], part[: j + 1], joined[i:]])
    return joined


def one_polygon(mask: NDArray[np.bool_], min_part_px: float = 16.0) -> Array | None:
    """Return a mask as one polygon: its parts joined, specks left out.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
    min_part_px : float
        Parts of a smaller area are left out, the largest excepted.

    Returns
    -------
    ndarray of float64, shape (K, 2), or None
        None for an empty mask.

    Examples
    --------
    >>> one_polygon(np.zeros((4, 6), bool)) is None
    True
    """
    parts = _traced(mask)
    if not parts:
        return None
    # Bridges between corners only, far apart on long straight runs, could cross an outline.
    large = [p for p in parts if p is parts[0] or _area(p) >= min_part_px]
    return _straightened(join_parts(large))


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
"""Where the stem end lies, as words, and as (x, y) with y down."""


def keypoints_of_mask(mask: NDArray[np.bool_], stem: str) -> Array | None:
    """Return keypoints along the axis of an outline.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        A whole fruit.
    stem : str
        One of `DIRECTIONS`: where the stem end lies, seen from the fruit's middle.

    Returns
    -------
    ndarray of float64, shape (5, 3), or None
        u, v in pixels and visibility 2 of KP0 (blossom end) to KP4 (stem end), evenly along the
        outline's axis; None where the outline is too small, too round or bent too much, or the
        word does not tell its ends apart.

    Raises
    ------
    ValueError
        If the word is none of `DIRECTIONS`.

    Examples
    --------
    >>> mask = np.zeros((40, 100), bool)
    >>> mask[15:25, 10:91] = True
    >>> keypoints_of_mask(mask, "left")[:, 0].round().tolist()
    [90.0, 70.0, 50.0, 30.0, 10.0]
    """
    if stem not in DIRECTIONS:
        raise ValueError(f"{stem!r} is no direction: one of {', '.join(DIRECTIONS)}")
    line = axis_line(mask)
    if line is None:
        return None
    towards = float((line[-1] - line[0]) @ np.array(DIRECTIONS[stem]))
    norm = float(np.linalg.norm(line[-1] - line[0]) * np.linalg.norm(DIRECTIONS[stem]))
    if abs(towards) < 0.25 * norm:
        return None
    points = points_along(line if towards > 0 else line[::-1], SHARES)
    return np.column_stack([points, np.full(len(points), 2.0)])
