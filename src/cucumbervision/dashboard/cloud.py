"""A fruit's depth points and the tube that was fitted to them, to be turned on the page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.perception.masks import decode_rle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.store.records import FruitRecord

__all__ = ["fruit_cloud", "tube_rings"]

POINTS = 3500
AROUND = 20  # points of a ring
RINGS = 16
MARGIN_PX = 12
SLAB_M = 0.08  # what lies farther before or behind the fruit is left out


def fruit_cloud(capture: Capture, record: FruitRecord) -> dict[str, Any] | None:
    """Give a fruit's points and its tube in millimetres about the fruit's middle.

    Parameters
    ----------
    capture : Capture
        The frame.
    record : FruitRecord
        The fruit, with mask and methods.

    Returns
    -------
    dict or None
        'points' (x, y, z after each other, whole millimetres), 'colors' ('#rrggbb' each),
        'rings' and 'axis' (lines of such points); None where the fruit has no mask or no depth.
    """
    if record.mask is None:
        return None
    mask = decode_rle(record.mask, capture.height, capture.width)
    inside = mask & valid_depth(capture.depth_m)
    if not inside.any():
        return None
    middle_z = float(np.median(capture.depth_m[inside]))
    points, colors = _points(capture, inside, np.inf, POINTS, middle_z)
    near, near_colors = _points(capture, _around(mask) & ~mask, SLAB_M, POINTS // 3, middle_z)
    middle = np.median(points, axis=0)
    tube = next((m for m in record.methods if m.diameter_m), None)
    rings: list[NDArray[np.float64]] = []
    axis = np.zeros((0, 3))
    if tube is not None:
        axis = np.array(tube.path_m, np.float64)
        rings = tube_rings(axis, np.array(tube.diameter_m, np.float64))
    return {
        "points": _mm(np.concatenate([points, near]) - middle),
        "colors": [*_hex(colors), *_hex(near_colors // 2 + 90)],
        "rings": [_mm(ring - middle) for ring in rings],
        "axis": _mm(axis - middle) if len(axis) else [],
    }


def tube_rings(
    axis_m: NDArray[np.float64], diameter_m: NDArray[np.float64], rings: int = RINGS
) -> list[NDArray[np.float64]]:
    """Give circles about an axis, as closed lines of points.

    Parameters
    ----------
    axis_m : ndarray of float64, shape (K, 3)
        The axis, metres.
    diameter_m : ndarray of float64, shape (K,)
        The diameter at each point.

    Returns
    -------
    list of ndarray of float64, shape (AROUND + 1, 3)

    Examples
    --------
    >>> axis = np.stack([np.linspace(0, 0.2, 9), np.zeros(9), np.full(9, 0.5)], axis=1)
    >>> rings = tube_rings(axis, np.full(9, 0.04), rings=3)
    >>> len(rings), rings[1].shape, round(float(np.linalg.norm(rings[1][0] - axis[4])), 6)
    (3, (21, 3), 0.02)
    """
    chosen = np.unique(np.linspace(0, len(axis_m) - 1, rings).round().astype(int))
    ahead = np.gradient(axis_m, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    turn = np.linspace(0, 2 * np.pi, AROUND + 1)[:, None]
    found = []
    for k in chosen.tolist():
        # Any vector that is not along the axis serves to begin the circle.
        start = np.eye(3)[np.argmin(np.abs(ahead[k]))]
        one = np.cross(ahead[k], start)
        one /= np.linalg.norm(one)
        other = np.cross(ahead[k], one)
        found.append(axis_m[k] + diameter_m[k] / 2 * (np.cos(turn) * one + np.sin(turn) * other))
    return found


def _around(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box = np.zeros(mask.shape, bool)
    box[
        max(ys[0] - MARGIN_PX, 0) : ys[-1] + MARGIN_PX,
        max(xs[0] - MARGIN_PX, 0) : xs[-1] + MARGIN_PX,
    ] = True
    return box


def _points(
    capture: Capture, where: NDArray[np.bool_], slab_m: float, most: int, middle_z: float
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    chosen = where & valid_depth(capture.depth_m)
    if np.isfinite(slab_m):
        chosen &= np.abs(capture.depth_m - middle_z) < slab_m
    v, u = np.nonzero(chosen)
    step = max(1, len(v) // most)
    v, u = v[::step], u[::step]
    z = capture.depth_m[v, u].astype(np.float64)
    x, y = capture.intrinsics.rays(u.astype(np.float64), v.astype(np.float64))
    return np.stack([x * z, y * z, z], axis=1), capture.color[v, u]


def _mm(points_m: NDArray[np.float64]) -> list[float]:
    values: list[float] = np.round(1000 * points_m, 1).reshape(-1).tolist()
    return values


def _hex(colors: NDArray[np.uint8]) -> list[str]:
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colors.tolist()]
