"""Move keypoints onto the axis of a fruit's outline.

A pose network gives a fruit's two ends roughly, and which of them is the stem's; the outline gives
them to a pixel. An end near an end of the outline moves to the end of the outline's axis, without
the stalk. An end elsewhere is hidden and stays at the network's position. The points between are
spaced evenly along the axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.arrays import Array, Mask
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import distances_inside, mask_pixels, mask_window
from cucumbervision.tube.shape import arc_positions, points_along

_Axis = tuple[Array, Array, Array, Callable[[Array], Array]]

_LEAST_PIXELS = 80
_LEAST_SLIMNESS = 1.7  # a rounder outline has no reliable axis
_SAMPLES = 400
_FADE = 4  # a sixteenth of an end's shift remains in the middle of the fruit
KEYPOINT_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_STALK = 0.45  # of the body's thickness: thinner parts are stalk
_END_DISTANCE = 0.12  # of the length: largest distance between corresponding ends


def place_keypoints(instances: Iterable[Instance]) -> tuple[Instance, ...]:
    """Move keypoints onto the axes of the measured masks.

    Parameters
    ----------
    instances : iterable of Instance
        With a network's keypoints, and `mask` or `detector_mask`. Keypoints drawn by people, and
        fruit without a clear axis, stay as they are.

    Returns
    -------
    tuple of Instance
        In the same order; visibilities and direction stay.

    Examples
    --------
    >>> from cucumbervision.fruit.instance import Instance
    >>> mask = np.zeros((40, 120), bool)
    >>> mask[10:30, 10:91] = True
    >>> mask[19:22, 91:101] = True  # the stalk
    >>> points = np.column_stack([np.linspace(14, 94, 5), np.full(5, 22.0), np.ones(5)])
    >>> box = np.array([9.5, 9.5, 100.5, 29.5])
    >>> instance = Instance(box, 0.9, mask=mask, keypoints=points, input_size_px=640)
    >>> (placed,) = place_keypoints([instance])
    >>> placed.keypoints[:, 0].round().tolist()
    [10.0, 30.0, 50.0, 70.0, 90.0]
    """
    return tuple(_with_placed_keypoints(instance) for instance in instances)


def _with_placed_keypoints(instance: Instance) -> Instance:
    mask = instance.detector_mask if instance.mask is None else instance.mask
    points = instance.keypoints
    is_given = instance.input_size_px is None
    if mask is None or points is None or is_given or not np.isfinite(points[:, :2]).all():
        return instance
    body = body_without_stalk(mask)
    axis = None if body is None else _axis(body)
    line = None if body is None or axis is None else _line_along(body, axis)
    if body is None or axis is None or line is None:
        return instance
    ends = points[[0, -1], :2]
    orders = [(np.linalg.norm(t - ends, axis=1), t) for t in (line[[0, -1]], line[[-1, 0]])]
    off_px, tips = min(orders, key=lambda order: float(order[0].sum()))
    is_close = off_px <= _END_DISTANCE * arc_positions(points[:, :2])[-1]
    if not is_close.any():
        return instance
    line = points[:, :2].copy()
    line[[0, -1]] = np.where(is_close[:, None], tips, ends)
    spread = _points_between(body, axis, line[[0, -1]]) if is_close.all() else None
    if spread is None:
        spread = points_along(line, KEYPOINT_SHARES)
    return replace(instance, keypoints=np.column_stack([spread, points[:, 2]]))


def body_without_stalk(mask: Mask) -> Mask | None:
    """Return a mask without the parts thinner than 45 % of its largest thickness.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)

    Returns
    -------
    ndarray of bool, shape (H, W), or None
        The largest part after opening with a disc; None for an empty mask.
    """
    window = mask_window(mask, 2)
    if window is None:
        return None
    inside = distances_inside(np.pad(mask[window], 1))
    radius = _STALK * float(inside.max())
    # The opening is the union of all discs inside the mask.
    opened = distances_inside(inside <= radius) < radius
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened.astype(np.uint8))
    if count > 2:
        opened = labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    body = np.zeros(mask.shape, bool)
    body[window] = opened[1:-1, 1:-1] & mask[window]
    return body


def axis_line(mask: Mask) -> Array | None:
    """Return the axis of an outline from one end to the other.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)

    Returns
    -------
    ndarray of float64, shape (K, 2), or None
        u, v in pixels; None if the outline is too small, too round or too bent.

    Notes
    -----
    The axis is a cubic fitted to all pixels by least squares, in the frame of their principal axes,
    cut where it leaves the outline.
    """
    axis = _axis(mask)
    return None if axis is None else _line_along(mask, axis)


def _line_along(mask: Mask, axis: _Axis) -> Array | None:
    middle, frame, along, curve = axis
    s = np.linspace(along.min(), along.max(), _SAMPLES)
    line = middle + np.stack([s, curve(s)], axis=1) @ frame
    inside = _inside(mask, line)
    first, last = int(inside.argmax()), _SAMPLES - int(inside[::-1].argmax())
    return line[first:last] if inside.any() and inside[first:last].all() else None


def keypoints_between(mask: Mask, ends_px: ArrayLike) -> Array | None:
    """Return five points along the axis of an outline from one known end to the other.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        A whole fruit, with or without its stalk.
    ends_px : array_like, shape (2, 2)
        u, v of both ends, pixels.

    Returns
    -------
    ndarray of float64, shape (5, 2), or None
        u, v in pixels, evenly spaced from the first end to the second; None if the outline is too
        small, too round or too bent.

    Notes
    -----
    The line of `axis_line` between the projections of both ends, shifted to meet them; each shift
    fades towards the other end.

    Examples
    --------
    >>> mask = np.zeros((40, 100), bool)
    >>> mask[15:25, 10:91] = True
    >>> keypoints_between(mask, [[90, 20], [18, 20]])[:, 0].round().tolist()
    [90.0, 72.0, 54.0, 36.0, 18.0]
    """
    axis = _axis(mask)
    return None if axis is None else _points_between(mask, axis, np.asarray(ends_px, np.float64))


def _points_between(mask: Mask, axis: _Axis, ends: Array) -> Array | None:
    middle, frame, _, curve = axis
    first, last = (ends - middle) @ frame[0]
    s = np.linspace(first, last, _SAMPLES)
    line = middle + np.stack([s, curve(s)], axis=1) @ frame
    share = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    line += (1 - share) ** _FADE * (ends[0] - line[0]) + share**_FADE * (ends[1] - line[-1])
    # Near its ends the line may run along the outline.
    if not _inside(mask, line[_SAMPLES // 10 : -_SAMPLES // 10]).all():
        return None
    return points_along(line, KEYPOINT_SHARES)


def _axis(mask: Mask) -> _Axis | None:
    """Return the pixels' centre, their principal axes, coordinates along, and the cubic."""
    pixels = mask_pixels(mask)
    if len(pixels) < _LEAST_PIXELS:
        return None
    middle = pixels.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((pixels - middle).T))
    if spread[1] < _LEAST_SLIMNESS**2 * spread[0]:
        return None
    frame = axes.T[::-1]
    along, across = ((pixels - middle) @ frame.T).T
    return middle, frame, along, np.polynomial.Polynomial.fit(along, across, 3)


def _inside(mask: Mask, line: Array) -> Mask:
    u, v = np.rint(line).astype(int).T
    height, width = mask.shape
    within = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    is_inside = np.zeros(len(line), np.bool_)
    is_inside[within] = mask[v[within], u[within]]
    return is_inside
