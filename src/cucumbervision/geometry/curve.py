"""Polylines and splines in space: lengths, and points along them."""

from __future__ import annotations

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
