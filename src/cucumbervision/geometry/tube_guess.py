"""A first guess of a tube in a cloud of surface points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.axis import principal_axis
from cucumbervision.geometry.tube_shape import TubeShape, shape_from_curve

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["guess_shape", "near_depths"]

ROUNDS = 4
DEEP_M = 0.03  # what a bent and round fruit stands out of its plane
PLANE_ROUNDS, PLANE_RIDGE, LEAST_OFF_M = 6, 1e-6, 0.002


def near_depths(points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Say which points are near the plane that most of them lie along.

    A tilted fruit lies along a plane however steep it is and whatever hides its middle; what
    the mask caught of the background does not, nor what the sensor blends between the two.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Camera coordinates, metres.

    Returns
    -------
    ndarray of bool, shape (N,)
        Within three median deviations and `DEEP_M` in depth.

    Examples
    --------
    >>> x = np.linspace(-0.1, 0.1, 9)
    >>> steep = np.stack([x, 0.1 * x, 0.6 + x], axis=1)
    >>> near_depths(np.vstack([steep, [[0.05, 0.0, 0.9]]])).tolist()[-2:]
    [True, False]
    """
    far = points_m[:, 2]
    # A plane in space is linear in the inverse depth over the picture.
    terms = np.column_stack([points_m[:, :2] / far[:, None], np.ones(len(far))])
    weight = np.ones(len(far))
    for _ in range(PLANE_ROUNDS):  # towards the least sum of absolute deviations
        weighted = terms * weight[:, None]
        ridge = PLANE_RIDGE * np.diag([1.0, 1.0, 0.0]) * weight.sum()
        plane = np.linalg.solve(weighted.T @ terms + ridge, weighted.T @ (1 / far))
        off = np.abs(1 / far - terms @ plane) * far**2
        weight = 1 / np.maximum(off, LEAST_OFF_M)
    near: NDArray[np.bool_] = off <= 3.0 * np.median(off) + DEEP_M
    return near


def guess_shape(points_m: NDArray[np.float64], *, gated: bool = True) -> TubeShape:
    """Guess a tube: a parabola along the principal axis, moved inward by its own radius.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Points of the visible surface, camera coordinates, metres.
    gated : bool
        Whether to leave out what `near_depths` does.

    Returns
    -------
    TubeShape
        Its ends one radius short of the cloud's.

    Examples
    --------
    >>> x, a = (m.ravel() for m in np.meshgrid(np.linspace(0, 0.2, 99), np.linspace(-1, 1, 30)))
    >>> cloud = np.stack([x, 0.02 * a, 0.5 - 0.02 * np.sqrt(1 - a**2)], axis=1)
    >>> centres, radii = guess_shape(cloud).balls(3)
    >>> bool(abs(centres[1, 2] - 0.5) < 0.005), bool(abs(radii[1] - 0.02) < 0.005)
    (True, True)
    """
    level = near_depths(points_m) if gated else np.ones(len(points_m), dtype=bool)
    near = level
    for _ in range(ROUNDS):
        centroid, axis = principal_axis(points_m[near])
        along = (points_m - centroid) @ axis
        off = points_m - centroid - along[:, None] * axis
        power = np.stack([np.ones_like(along), along, along**2], axis=1)
        bow = np.linalg.lstsq(power[near], off[near], rcond=None)[0]
        rest = off - power @ bow
        left = np.linalg.norm(rest, axis=1)
        near = level & (left <= 3.0 * np.median(left[near]) + 1e-6)
    view = centroid / np.linalg.norm(centroid)
    side = np.cross(axis, view)
    norm = float(np.linalg.norm(side))
    across = np.abs(rest[near] @ side) / norm if norm > 0.05 else left[near]
    radius = 2.0 * float(np.median(across))
    low, high = np.quantile(along[near], [0.002, 0.998])
    short = min(radius, 0.4 * (high - low))
    t = np.linspace(low + short, high - short, 33)
    curve = centroid + t[:, None] * axis + np.stack([np.ones_like(t), t, t**2], axis=1) @ bow
    curve += 0.785 * radius * curve / np.linalg.norm(curve, axis=1)[:, None]
    return shape_from_curve(curve, max(radius, 1e-3))
