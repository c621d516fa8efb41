"""A tube: balls along a cubic B-spline."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BEND_SEGMENTS = 4
WIDTH_SEGMENTS = 12
BALLS = 64


@dataclass(frozen=True, eq=False)
class TubeShape:
    """Balls along a curve: control points of the curve and of the radius.

    Parameters
    ----------
    bend_m : ndarray of float64, shape (7, 3)
        Control points of the centres' uniform cubic B-spline, metres.
    width_m : ndarray of float64, shape (15,)
        Control values of the radius' uniform cubic B-spline, metres.
    """

    bend_m: NDArray[np.float64]
    width_m: NDArray[np.float64]

    @property
    def length_m(self) -> float:
        """Length of the curve and the radii at its ends, metres: about the axis from end to end."""
        centres, radii = self.balls()
        steps = centres[1:] - centres[:-1]
        return float(np.sqrt(np.einsum("ij,ij->i", steps, steps)).sum() + radii[0] + radii[-1])

    def balls(self, count: int = BALLS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centres, shape (count, 3), and radii, shape (count,), evenly along the curve."""
        bend, width = bases(count)
        return bend @ self.bend_m, width @ self.width_m


def cubic_basis(t: NDArray[Any], segments: int) -> NDArray[np.float64]:
    """Compute each control point's weight at each parameter.

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
    The uniform cubic basis (de Boor 1978), knots at multiples of 1 / segments on both sides; to the
    last bit that of SciPy's `BSpline.design_matrix`, which takes a tenth of the program's start to
    import.

    Examples
    --------
    >>> (6 * cubic_basis(np.array([0.0, 0.5, 1.0]), 1)).round(3).tolist()
    [[1.0, 4.0, 1.0, 0.0], [0.125, 2.875, 2.875, 0.125], [0.0, 1.0, 4.0, 1.0]]
    """
    knots = np.arange(-3, segments + 4) / segments
    piece = np.clip(np.searchsorted(knots, t, side="right") - 1, 3, segments + 2)
    rows = np.zeros((len(t), 4))
    rows[:, 0] = 1
    for degree in (1, 2, 3):
        lower = rows[:, :degree].copy()
        rows[:, 0] = 0
        for n in range(1, degree + 1):
            right, left = knots[piece + n], knots[piece + n - degree]
            weight = lower[:, n - 1] / (right - left)
            rows[:, n - 1] += weight * (right - t)
            rows[:, n] = weight * (t - left)
    basis = np.zeros((len(t), segments + 3))
    basis[np.arange(len(t))[:, None], piece[:, None] + np.arange(-3, 1)] = rows
    return basis


@lru_cache(maxsize=16)
def bases(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the bases of centre and radius at evenly spaced places, (count, 7) and (count, 15)."""
    t = np.linspace(0.0, 1.0, count)
    return cubic_basis(t, BEND_SEGMENTS), cubic_basis(t, WIDTH_SEGMENTS)


def shape_from_curve(curve_m: NDArray[np.float64], radius_m: float) -> TubeShape:
    """Return the tube of constant radius along a polyline.

    Parameters
    ----------
    curve_m : ndarray of float64, shape (K, 3)
        At least 7 points evenly spaced along the curve.
    radius_m : float
        The radius.

    Examples
    --------
    >>> x = np.linspace(0, 0.2, 33)
    >>> shape = shape_from_curve(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), 0.02)
    >>> centres, radii = shape.balls(3)
    >>> (centres[:, [0, 2]].round(4) + 0.0).tolist(), radii.round(4).tolist()
    ([[0.0, 0.5], [0.1, 0.5], [0.2, 0.5]], [0.02, 0.02, 0.02])
    """
    bend = np.linalg.lstsq(bases(len(curve_m))[0], curve_m, rcond=None)[0]
    return TubeShape(np.asarray(bend, dtype=np.float64), np.full(WIDTH_SEGMENTS + 3, radius_m))
