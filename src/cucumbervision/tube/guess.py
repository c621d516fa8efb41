"""Tubes to begin a fit with: along the points, the picture or the middle line of a mask."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.tube.pixels import median_of
from cucumbervision.tube.shape import arc_positions, principal_axis, shape_from_curve

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.tube.shape import TubeShape

_ROUNDS = 4
_DEEP_M = 0.03  # what a bent and round fruit stands out of its plane
_LEAST_MIDLINE = 9  # points of a mask, and readings, that a middle line needs
_PLANE_ROUNDS, _PLANE_RIDGE, _LEAST_OFF_M = 6, 1e-6, 0.002


def near_depths(points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points are near the plane that most of them lie along.

    A tilted fruit lies along a plane however steep it is and whatever hides its middle; what
    the mask caught of the background does not, nor what the sensor blends between the two.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Camera coordinates, metres.

    Returns
    -------
    ndarray of bool, shape (N,)
        Within three median deviations and `_DEEP_M` in depth.

    Examples
    --------
    >>> x = np.linspace(-0.1, 0.1, 9)
    >>> steep = np.stack([x, 0.1 * x, 0.6 + x], axis=1)
    >>> near_depths(np.vstack([steep, [[0.05, 0.0, 0.9]]])).tolist()[-2:]
    [True, False]
    """
    depth_m = points_m[:, 2]
    # A plane in space is linear in the inverse depth over the picture.
    terms = np.column_stack([points_m[:, :2] / depth_m[:, None], np.ones(len(depth_m))])
    weight = np.ones(len(depth_m))
    for _ in range(_PLANE_ROUNDS):  # towards the least sum of absolute deviations
        weighted = terms * weight[:, None]
        ridge = _PLANE_RIDGE * np.diag([1.0, 1.0, 0.0]) * weight.sum()
        plane = np.linalg.solve(weighted.T @ terms + ridge, weighted.T @ (1 / depth_m))
        off = np.abs(1 / depth_m - terms @ plane) * depth_m**2
        weight = 1 / np.maximum(off, _LEAST_OFF_M)
    inliers: NDArray[np.bool_] = off <= 3.0 * median_of(off) + _DEEP_M
    return inliers


def guess_shape(points_m: NDArray[np.float64], level: NDArray[np.bool_] | None = None) -> TubeShape:
    """Guess a tube: a parabola along the principal axis, moved inward by its own radius.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Points of the visible surface, camera coordinates, metres.
    level : ndarray of bool, shape (N,), optional
        Which points may be the fruit's: what `near_depths` says; all points without.

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
    if level is None:
        level = np.ones(len(points_m), dtype=bool)
    inliers = level
    for _ in range(_ROUNDS):
        centroid, axis = principal_axis(points_m[inliers])
        along = (points_m - centroid) @ axis
        off = points_m - centroid - along[:, None] * axis
        power = np.stack([np.ones_like(along), along, along**2], axis=1)
        bow = np.linalg.lstsq(power[inliers], off[inliers], rcond=None)[0]
        residual = off - power @ bow
        distance = np.sqrt(np.einsum("ij,ij->i", residual, residual))
        inliers = level & (distance <= 3.0 * median_of(distance[inliers]) + 1e-6)
    view = centroid / np.linalg.norm(centroid)
    side = np.cross(axis, view)
    norm = float(np.linalg.norm(side))
    across = np.abs(residual[inliers] @ side) / norm if norm > 0.05 else distance[inliers]
    radius = 2.0 * median_of(across)
    start, stop = np.quantile(along[inliers], [0.002, 0.998])
    short = min(radius, 0.4 * (stop - start))
    t = np.linspace(start + short, stop - short, 33)
    curve = centroid + t[:, None] * axis + np.stack([np.ones_like(t), t, t**2], axis=1) @ bow
    curve += 0.785 * radius * curve / np.linalg.norm(curve, axis=1)[:, None]
    return shape_from_curve(curve, max(radius, 1e-3))


def guess_from_picture(
    picture: NDArray[np.float64],
    has_depth: NDArray[np.bool_],
    inverse_depth: NDArray[np.float64],
    *,
    by_girth: bool = False,
) -> TubeShape:
    """Guess a tube from its mask: a parabola in the picture, on a plane in depth.

    Of a fruit nearer than the sensor can see hardly a reading is left to lay a plane through;
    then its outline tells how it lies: a fruit about as thick all along looks thicker the nearer
    it is.

    Parameters
    ----------
    picture : ndarray of float64, shape (N, 2)
        The mask's pixels as x / z and y / z.
    has_depth : ndarray of bool, shape (N,)
        Which of them have a depth reading.
    inverse_depth : ndarray of float64, shape (K,)
        One over the depth of these, 1/m.
    by_girth : bool
        Whether the plane's slope is the outline's rather than that of the readings.

    Returns
    -------
    TubeShape
        Its ends one radius short of the mask's.

    Examples
    --------
    >>> x, a = (m.ravel() for m in np.meshgrid(np.linspace(0, 0.4, 99), np.linspace(-1, 1, 30)))
    >>> mask = np.stack([x, 0.04 * a], axis=1)
    >>> guess = guess_from_picture(mask, np.abs(a) < 0.5, np.full((np.abs(a) < 0.5).sum(), 2.0))
    >>> centres, radii = guess.balls(3)
    >>> centres[:, 0].round(2).tolist(), radii[1].round(2).tolist()
    ([0.02, 0.1, 0.18], 0.02)
    """
    middle = picture.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((picture - middle).T))
    along, across = ((picture - middle) @ axes[:, k] for k in (1, 0))
    power = np.stack([np.ones_like(along), along, along**2], axis=1)
    bow = np.linalg.lstsq(power, across, rcond=None)[0]
    half = 2.0 * float(np.median(np.abs(across - power @ bow)))
    terms, weight = power[has_depth][:, :2], np.ones(len(inverse_depth))
    girth = np.linalg.lstsq(power[:, :2], np.abs(across - power @ bow), rcond=None)[0]
    plane = girth * np.median(inverse_depth / np.maximum(terms @ girth, 0.05 * half))
    for _ in range(0 if by_girth else _PLANE_ROUNDS):  # to the least sum of absolute deviations
        weighted = terms * weight[:, None]
        plane = np.linalg.lstsq(weighted.T @ terms, weighted.T @ inverse_depth, rcond=None)[0]
        off = np.abs(inverse_depth - terms @ plane) / np.median(inverse_depth) ** 2
        weight = 1 / np.maximum(off, _LEAST_OFF_M)
    start, stop = np.quantile(along, [0.005, 0.995])
    short = min(half, 0.4 * (stop - start))
    t = np.linspace(start + short, stop - short, 33)
    powers = np.stack([np.ones_like(t), t, t**2], axis=1)
    line = middle + t[:, None] * axes[:, 1] + (powers @ bow)[:, None] * axes[:, 0]
    usual = float(np.median(inverse_depth))
    depth_m = 1 / np.clip(powers[:, :2] @ plane, 0.5 * usual, 2.0 * usual)
    radius = max(half / usual, 1e-3)
    curve = np.column_stack([line, np.ones(len(line))]) * depth_m[:, None]
    curve += 0.785 * radius * curve / np.linalg.norm(curve, axis=1)[:, None]
    return shape_from_curve(curve, radius)


def guess_from_midline(
    picture: NDArray[np.float64], mask: NDArray[np.bool_], depth_m: NDArray[np.float64]
) -> TubeShape | None:
    """Guess a tube along the middle line of its mask, however much the fruit bends.

    The line is the cheapest path between the two points of the mask that are farthest apart
    within it, where a step costs the more the nearer it is to the outline (Dijkstra 1959).

    Parameters
    ----------
    picture : ndarray of float64, shape (G, 2)
        A grid over the mask's window as x / z and y / z.
    mask : ndarray of bool, shape (G,)
        Which of its points belong to the mask.
    depth_m : ndarray of float64, shape (G,)
        The depth there, metres; 0 where there is none.

    Returns
    -------
    TubeShape or None
        Its ends one radius short of the mask's; None without outline, depth, or a path.

    Examples
    --------
    A half ring of 8 cm radius, 3 cm wide, at 0.5 m:

    >>> sides = np.linspace(-0.25, 0.25, 81), np.linspace(0, 0.25, 41)
    >>> x, y = (m.ravel() for m in np.meshgrid(*sides))
    >>> ring = np.abs(np.hypot(x, y) - 0.16) < 0.03
    >>> guess = guess_from_midline(np.stack([x, y], axis=1), ring, np.full(len(x), 0.5))
    >>> centres, radii = guess.balls(9)
    >>> bool(np.abs(np.hypot(*centres[2:-2, :2].T) - 0.082).max() < 0.005), float(radii[4].round(2))
    (True, 0.02)
    """
    from scipy.spatial import cKDTree

    points, readable = picture[mask], mask & (depth_m > 0)
    if len(points) < _LEAST_MIDLINE or readable.sum() < _LEAST_MIDLINE or mask.all():
        return None
    tree = cKDTree(points)
    step = float(np.median(_nearest(tree, points, 2)[0][:, 1]))
    inside = _nearest(cKDTree(picture[~mask]), points, 1)[0][:, 0]
    pairs = tree.query_pairs(1.6 * step, output_type="ndarray")
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    within = _graph(pairs, lengths, len(points))
    first = _farthest(_paths(within, int(np.argmax(inside)))[0])
    last = _farthest(_paths(within, first)[0])
    cost = lengths / (inside[pairs].mean(axis=1) / inside.max()) ** 2
    before = _paths(_graph(pairs, cost, len(points)), first)[1]
    line = [last]
    while line[-1] != first and len(line) < len(points):
        line.append(int(before[line[-1]]))
    half = float(np.median(inside[line]))
    along = arc_positions(points[line])
    short = min(half, 0.4 * along[-1])
    positions = np.linspace(short, along[-1] - short, 33)
    path = np.stack([np.interp(positions, along, points[line][:, k]) for k in (0, 1)], axis=1)
    neighbours = _nearest(cKDTree(picture[readable]), path, _LEAST_MIDLINE)[1]
    line_depth_m = np.median(depth_m[readable][neighbours], axis=1)
    curve = np.column_stack([path, np.ones(len(path))]) * line_depth_m[:, None]
    radius = max(half * float(np.median(line_depth_m)), 1e-3)
    curve += 0.785 * radius * curve / np.linalg.norm(curve, axis=1)[:, None]
    return shape_from_curve(curve, radius)


def _nearest(
    tree: Any, points: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    # Distances and numbers of the nearest points, (N, count) each.
    distance, number = tree.query(points, k=range(1, count + 1))
    return np.asarray(distance), np.asarray(number)


def _graph(pairs: NDArray[np.intp], cost: NDArray[np.float64], count: int) -> Any:
    # Of points: what the way between the two of each pair costs.
    from scipy.sparse import coo_array

    ends = pairs.T.astype(np.int32)  # SciPy 1.13 takes no other indices
    return coo_array((cost, (ends[0], ends[1])), shape=(count, count)).tocsr()


def _paths(graph: Any, start: int) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    # What the way from a point to each other point costs, and the last point before that one.
    from scipy.sparse import csgraph

    result: Any = csgraph.dijkstra(graph, False, start, True)  # type: ignore[call-overload]
    return np.asarray(result[0]), np.asarray(result[1])


def _farthest(distance: NDArray[np.float64]) -> int:
    return int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))
