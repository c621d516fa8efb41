"""Uniform cubic B-splines over [0, 1]: basis, and the differences that measure roughness."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["cubic_basis", "cubic_basis_slope", "differences"]


def cubic_basis(t: NDArray[Any], segments: int) -> NDArray[np.float64]:
    """Give each control point's weight at each parameter.

    Parameters
    ----------
    t : ndarray of float, shape (N,)
        Parameters in [0, 1].
    segments : int
        Number of polynomial pieces; there are `segments + 3` control points.

    Returns
    -------
    ndarray of float64, shape (N, segments + 3)
        Rows sum to 1.

    Notes
    -----
    The uniform cubic basis (de Boor 1978), knots at multiples of 1 / segments on both sides.

    Examples
    --------
    >>> cubic_basis(np.array([0.0]), 2).round(4).tolist()
    [[0.1667, 0.6667, 0.1667, 0.0, 0.0]]
    """
    piece, u = _piece(t, segments)
    v = 1 - u
    weights = np.stack(
        [v**3, 3 * u**3 - 6 * u**2 + 4, 3 * v**3 - 6 * v**2 + 4, u**3],
        axis=1,
    )
    return _spread(weights / 6, piece, segments)


def cubic_basis_slope(t: NDArray[Any], segments: int) -> NDArray[np.float64]:
    """Give the derivative of `cubic_basis` by the parameter, shape (N, segments + 3).

    Examples
    --------
    >>> cubic_basis_slope(np.array([0.0]), 2).tolist()
    [[-1.0, 0.0, 1.0, 0.0, 0.0]]
    """
    piece, u = _piece(t, segments)
    v = 1 - u
    slopes = np.stack(
        [-(v**2), 3 * u**2 - 4 * u, 4 * v - 3 * v**2, u**2],
        axis=1,
    )
    return _spread(slopes * (segments / 2), piece, segments)


def differences(controls: int, order: int) -> NDArray[np.float64]:
    """Give the matrix that takes control points to their differences of an order.

    Examples
    --------
    >>> differences(4, 2).tolist()
    [[1.0, -2.0, 1.0, 0.0], [0.0, 1.0, -2.0, 1.0]]
    """
    return np.diff(np.eye(controls), order, axis=0)


def _piece(t: NDArray[Any], segments: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    x = np.asarray(t, dtype=np.float64) * segments
    piece = np.clip(x.astype(np.intp), 0, segments - 1)
    return piece, x - piece


def _spread(
    weights: NDArray[np.float64], piece: NDArray[np.intp], segments: int
) -> NDArray[np.float64]:
    basis = np.zeros((len(piece), segments + 3))
    np.put_along_axis(basis, piece[:, None] + np.arange(4), weights, axis=1)
    return basis
