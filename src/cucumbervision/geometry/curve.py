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
    from scipy.interpolate import CubicSpline

    step = np.linalg.norm(np.diff(vertices_m, axis=0), axis=1)
    apart = step > _COINCIDENT * step.sum()
    keep = np.concatenate(([True], apart))
    vertices, step = np.asarray(vertices_m, dtype=np.float64)[keep], step[apart]
    if len(vertices) < 2:
        raise ValueError("a curve needs two distinct vertices")
    parameter = np.concatenate(([0.0], np.cumsum(step))) / step.sum()
    spline = CubicSpline(parameter, vertices, bc_type="natural")
    u = np.linspace(0.0, 1.0, samples)
    speed = np.linalg.norm(spline(u, 1), axis=1)
    return float(np.trapezoid(speed, u)), spline(u)


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
