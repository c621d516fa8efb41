"""Polylines, splines and principal axes in space: lengths, and points along them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


_COINCIDENT = 1e-9  # of the whole: closer vertices are one, or their parameters would be


def polyline_length(vertices_m: NDArray[Any]) -> float:
    """Return the summed length of the segments.

    Parameters
    ----------
    vertices_m : ndarray of float, shape (K, D)
        In order.

    Examples
    --------
    >>> polyline_length(np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0]]))
    6.0
    """
    return float(np.linalg.norm(np.diff(vertices_m, axis=0), axis=1).sum())


def natural_spline(
    vertices_m: NDArray[Any], samples: int = 1000
) -> tuple[float, NDArray[np.float64]]:
    """Lay a natural cubic spline through the vertices and integrate its length.

    The paper's Eqs. 5 and 6: one spline a coordinate over the chord-length parameter in [0, 1],
    second derivatives zero at both ends, the speed integrated by the trapezoidal rule.

    Parameters
    ----------
    vertices_m : ndarray of float, shape (K, 3)
        In order; vertices that coincide with the one before are dropped.
    samples : int
        Number of samples of the speed.

    Returns
    -------
    length_m : float
        Arc length.
    path_m : ndarray of float64, shape (`samples`, 3)
        The curve.

    Raises
    ------
    ValueError
        For fewer than two distinct vertices.

    Examples
    --------
    >>> t = np.linspace(0, np.pi / 2, 25)
    >>> arc = np.stack([0.2 * np.cos(t), 0.2 * np.sin(t), np.full(25, 0.5)], axis=1)
    >>> length, path = natural_spline(arc)
    >>> round(length, 4), round(0.2 * np.pi / 2, 4)
    (0.3142, 0.3142)
    """
    step = np.linalg.norm(np.diff(vertices_m, axis=0), axis=1)
    apart = step > _COINCIDENT * step.sum()
    keep = np.concatenate(([True], apart))
    vertices, step = np.asarray(vertices_m, dtype=np.float64)[keep], step[apart]
    if len(vertices) < 2:
        raise ValueError("a curve needs two distinct vertices")
    parameter = np.concatenate(([0.0], np.cumsum(step))) / step.sum()
    u = np.linspace(0.0, 1.0, samples)
    path, velocity = _spline_at(parameter, vertices, u)
    return float(np.trapezoid(np.linalg.norm(velocity, axis=1), u)), path


def _spline_at(
    knots: NDArray[np.float64], vertices: NDArray[np.float64], places: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Values and slopes of SciPy's natural CubicSpline; importing that and its linear algebra
    # takes a fifth of the program's start.
    gap = np.diff(knots)
    chord = np.diff(vertices, axis=0) / gap[:, None]
    above, below = np.r_[gap[0], gap[:-1]], np.r_[gap[1:], gap[-1]]
    middle = 2 * np.r_[gap[0], gap[:-1] + gap[1:], gap[-1]]
    right = 3 * np.concatenate(
        [
            vertices[1:2] - vertices[:1],
            gap[1:, None] * chord[:-1] + gap[:-1, None] * chord[1:],
            vertices[-1:] - vertices[-2:-1],
        ]
    )
    slope = _solved(below, middle, above, right)
    bow = (slope[:-1] + slope[1:] - 2 * chord) / gap[:, None]
    cubic, square = bow / gap[:, None], (chord - slope[:-1]) / gap[:, None] - bow
    piece = np.clip(np.searchsorted(knots, places, side="right") - 1, 0, len(gap) - 1)
    t = (places - knots[piece])[:, None]
    a, b, c, d = (part[piece] for part in (cubic, square, slope, vertices))
    return d + c * t + b * (t * t) + a * (t * t * t), c + b * t * 2 + a * (t * t) * 3


def _solved(
    below: NDArray[np.float64],
    middle: NDArray[np.float64],
    above: NDArray[np.float64],
    right: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Solve a tridiagonal system whose diagonal outweighs the rest: no rows change places."""
    pivots, answers = middle.tolist(), list(right)
    for row, (lower, upper) in enumerate(zip(below.tolist(), above.tolist(), strict=True)):
        factor = lower / pivots[row]
        pivots[row + 1] -= factor * upper
        answers[row + 1] = answers[row + 1] - factor * answers[row]
    answers[-1] = answers[-1] / pivots[-1]
    for row in range(len(above) - 1, -1, -1):
        answers[row] = (answers[row] - above[row] * answers[row + 1]) / pivots[row]
    return np.array(answers)


def arc_positions(centres_m: NDArray[Any]) -> NDArray[np.float64]:
    """Return each centre's arc length from the first, metres.

    Examples
    --------
    >>> arc_positions(np.array([[0.0, 0, 0], [3.0, 4.0, 0], [3.0, 4.0, 2.0]])).tolist()
    [0.0, 5.0, 7.0]
    """
    steps = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def points_along(vertices: NDArray[Any], shares: ArrayLike) -> NDArray[np.float64]:
    """Return the points of a polyline at shares of its length.

    Parameters
    ----------
    vertices : ndarray of float, shape (K, D)
        In order.
    shares : array_like, shape (N,)
        0 the first vertex, 1 the last.

    Returns
    -------
    ndarray of float64, shape (N, D)

    Examples
    --------
    >>> points_along(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]), [0.25, 0.75]).tolist()
    [[2.0, 0.0], [4.0, 2.0]]
    """
    run = arc_positions(vertices)
    positions = np.asarray(shares) * run[-1]
    return np.stack(
        [np.interp(positions, run, column) for column in np.asarray(vertices).T], axis=1
    )


@dataclass(frozen=True, eq=False)
class AlignedCloud:
    """A cloud with its principal axis.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Camera coordinates in metres.
    centroid_m, axis : ndarray of float64, shape (3,)
        From `principal_axis`; not a number below two points.
    along_m : ndarray of float64, shape (N,)
        Each point's position along the axis, metres from the centroid.
    """

    points_m: NDArray[np.float64]
    centroid_m: NDArray[np.float64]
    axis: NDArray[np.float64]
    along_m: NDArray[np.float64]


def align_near(points_m: NDArray[Any], half_width_m: float) -> AlignedCloud:
    """Gate a cloud by depth and find its principal axis: what M2, M3 and M5 begin with.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        Camera coordinates in metres.
    half_width_m : float
        As `depth_gate` takes it.

    Examples
    --------
    >>> cloud = align_near(np.array([[0.0, 0, 0.5], [0.2, 0, 0.5], [0.4, 0, 0.9]]), 0.035)
    >>> cloud.along_m.tolist()
    [-0.1, 0.1]
    """
    gated = depth_gate(points_m, half_width_m)
    if len(gated) < 2:
        nowhere = np.full(3, np.nan)
        return AlignedCloud(gated, nowhere, nowhere, np.full(len(gated), np.nan))
    centroid, axis = principal_axis(gated)
    along = np.asarray(gated @ axis - centroid @ axis, dtype=np.float64)
    return AlignedCloud(gated, centroid, axis, along)


def depth_gate(points_m: NDArray[Any], half_width_m: float) -> NDArray[Any]:
    """Keep the points whose depth is within `half_width_m` of the median depth.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        Camera coordinates in metres, z forward.
    half_width_m : float
        Half the gate's width in metres.

    Returns
    -------
    ndarray of float, shape (M, 3)
        The points kept, in their order; empty for an empty cloud.

    Examples
    --------
    >>> points = np.array([[0.0, 0.0, 0.50], [0.0, 0.0, 0.51], [0.0, 0.0, 0.90]])
    >>> depth_gate(points, 0.035)[:, 2].tolist()
    [0.5, 0.51]
    """
    if not len(points_m):
        return points_m
    z = points_m[:, 2]
    inside: NDArray[np.bool_] = np.abs(z - np.median(z)) <= half_width_m
    return points_m[inside]


def principal_axis(points_m: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centroid and the direction of largest spread.

    The first right singular vector of the centred cloud (the paper's Eq. 2), found as the first
    eigenvector of its scatter matrix: the same vector, without an SVD of N rows.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        At least two points; pixels (N, 2) give those of a mask, in pixels.

    Returns
    -------
    centroid_m, axis : ndarray of float64, shape (3,), or (2,) of pixels
        `axis` has length 1; its largest component is positive.

    Raises
    ------
    ValueError
        For fewer than two points.

    Examples
    --------
    >>> centroid, axis = principal_axis(np.array([[0.0, 0, 1], [2.0, 0, 1], [4.0, 0, 1]]))
    >>> centroid.tolist(), axis.round(6).tolist()
    ([2.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    """
    if len(points_m) < 2:
        raise ValueError(f"{len(points_m)} points have no axis")
    centroid = points_m.mean(axis=0, dtype=np.float64)
    centred = points_m - centroid
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return centroid, axis if axis[np.argmax(np.abs(axis))] > 0 else -axis


def bin_centroids(
    points_m: NDArray[Any], along_m: NDArray[Any], bins: int, at_least: int
) -> NDArray[np.float64]:
    """Cut a cloud into equal bins along an axis and give the centroids of the filled ones.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        The cloud.
    along_m : ndarray of float, shape (N,)
        Each point's position along the axis, as `project` gives it.
    bins : int
        Number of bins from the smallest to the largest position.
    at_least : int
        Bins with fewer points are skipped.

    Returns
    -------
    ndarray of float64, shape (B, 3)
        B <= `bins` centroids, in order along the axis.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0], [10.0, 2.0, 0]])
    >>> bin_centroids(points, points[:, 0], bins=2, at_least=2).tolist()
    [[0.5, 0.0, 0.0], [9.5, 1.0, 0.0]]
    """
    start, stop = float(along_m.min()), float(along_m.max())
    if stop <= start:
        return np.empty((0, 3))
    index = np.minimum(((along_m - start) * (bins / (stop - start))).astype(np.intp), bins - 1)
    count = np.bincount(index, minlength=bins)
    sums = [np.bincount(index, points_m[:, k], minlength=bins) for k in range(3)]
    filled = count >= at_least
    return np.stack([s[filled] / count[filled] for s in sums], axis=1)
