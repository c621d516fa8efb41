"""Five keypoints from a whole fruit's mask and its ends, or a word on which end bears the stalk.

Photos whose fruit somebody only boxed become keypoint labels by it. They are pseudo-labels: the
axis is that of the outline, not of the body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.curve import points_along

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

__all__ = ["DIRECTIONS", "keypoints_between", "keypoints_of_mask"]

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

LEAST_PIXELS = 80
LEAST_SLIMNESS = 1.7  # a rounder outline has no axis that one could trust
SAMPLES = 400
FADE = 4  # in the middle of the fruit a sixteenth of an end's shift is left
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


def keypoints_of_mask(mask: NDArray[np.bool_], stem: str) -> NDArray[np.float64] | None:
    """Give keypoints along the axis of an outline.

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

    Notes
    -----
    The axis is the cubic that lies in the middle of the pixels in the frame of their principal
    axes (least squares over all of them), cut where it leaves the outline.

    Examples
    --------
    >>> mask = np.zeros((40, 100), bool)
    >>> mask[15:25, 10:91] = True
    >>> keypoints_of_mask(mask, "left")[:, 0].round().tolist()
    [90.0, 70.0, 50.0, 30.0, 10.0]
    """
    if stem not in DIRECTIONS:
        raise ValueError(f"{stem!r} is no direction: one of {', '.join(DIRECTIONS)}")
    axis = _axis(mask)
    if axis is None:
        return None
    middle, frame, along, curve = axis
    s = np.linspace(along.min(), along.max(), SAMPLES)
    line = middle + np.stack([s, curve(s)], axis=1) @ frame
    inside = _inside(mask, line)
    first, last = int(inside.argmax()), SAMPLES - int(inside[::-1].argmax())
    if not inside.any() or not inside[first:last].all():
        return None
    line = line[first:last]
    towards = float((line[-1] - line[0]) @ np.array(DIRECTIONS[stem]))
    norm = float(np.linalg.norm(line[-1] - line[0]) * np.linalg.norm(DIRECTIONS[stem]))
    if abs(towards) < 0.25 * norm:
        return None
    points = points_along(line if towards > 0 else line[::-1], SHARES)
    return np.column_stack([points, np.full(len(points), 2.0)])


def keypoints_between(mask: NDArray[np.bool_], ends_px: ArrayLike) -> NDArray[np.float64] | None:
    """Return keypoints along the axis of an outline from one known end to the other.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        A whole fruit; its stalk may be in it.
    ends_px : array_like, shape (2, 2)
        u, v of the blossom end and of the stem end, pixels.

    Returns
    -------
    ndarray of float64, shape (5, 3), or None
        u, v in pixels and visibility 2 of KP0 (blossom end) to KP4 (stem end), evenly along the
        line; None where the outline is too small, too round or bent too much.

    Notes
    -----
    The line is that of `keypoints_of_mask` between the feet of both ends, shifted so that it meets
    them; what shifts it fades from each end to the other.

    Examples
    --------
    >>> mask = np.zeros((40, 100), bool)
    >>> mask[15:25, 10:91] = True
    >>> keypoints_between(mask, [[90, 20], [18, 20]])[:, 0].round().tolist()
    [90.0, 72.0, 54.0, 36.0, 18.0]
    """
    ends = np.asarray(ends_px, np.float64)
    axis = _axis(mask)
    if axis is None:
        return None
    middle, frame, _, curve = axis
    first, last = (ends - middle) @ frame[0]
    s = np.linspace(first, last, SAMPLES)
    line = middle + np.stack([s, curve(s)], axis=1) @ frame
    share = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    line += (1 - share) ** FADE * (ends[0] - line[0]) + share**FADE * (ends[1] - line[-1])
    # At the very ends the line may run along the outline.
    if not _inside(mask, line[SAMPLES // 10 : -SAMPLES // 10]).all():
        return None
    points = points_along(line, SHARES)
    return np.column_stack([points, np.full(len(points), 2.0)])


def _axis(
    mask: NDArray[np.bool_],
) -> (
    tuple[
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        Callable[[NDArray[np.float64]], NDArray[np.float64]],
    ]
    | None
):
    """Return the pixels' middle, their principal axes, their places along and the axis across."""
    pixels = np.argwhere(mask)[:, ::-1].astype(np.float64)
    if len(pixels) < LEAST_PIXELS:
        return None
    middle = pixels.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((pixels - middle).T))
    if spread[1] < LEAST_SLIMNESS**2 * spread[0]:
        return None
    frame = axes.T[::-1]
    along, across = ((pixels - middle) @ frame.T).T
    return middle, frame, along, np.polynomial.Polynomial.fit(along, across, 3)


def _inside(mask: NDArray[np.bool_], line: NDArray[np.float64]) -> NDArray[np.bool_]:
    u, v = np.rint(line).astype(int).T
    height, width = mask.shape
    within = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    found = np.zeros(len(line), np.bool_)
    found[within] = mask[v[within], u[within]]
    return found
