"""A tube's shape as spline control points, and how far readings are from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.bspline import cubic_basis

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "BALLS",
    "BEND_SEGMENTS",
    "Gaps",
    "TubeShape",
    "bases",
    "depth_gaps",
    "gaps",
    "shape_from_curve",
]

BEND_SEGMENTS = 4
WIDTH_SEGMENTS = 12
BALLS = 64
FINE = 1024  # positions along the curve to which a nearest ball is rounded
GRAZING = 0.2  # the cosine below which a ray only grazes the body
MISSED_M = 100.0


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

    def balls(self, count: int = BALLS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Give centres, shape (count, 3), and radii, shape (count,), evenly along the curve."""
        bend, width = bases(count)
        return bend @ self.bend_m, width @ self.width_m

    @property
    def ends_basis(self) -> NDArray[np.float64]:
        """Weights of the control points in the curve's two ends, shape (2, 7)."""
        return bases(2)[0]


@dataclass(frozen=True, eq=False)
class Gaps:
    """Signed gaps between readings and a shape, and where on it they are measured.

    Parameters
    ----------
    gap_m : ndarray of float64, shape (N,)
        Metres; positive outside the body.
    away : ndarray of float64, shape (N, 3)
        Unit vector from the reading to the nearest ball's centre: the gap's derivative by it.
    bend_basis, width_basis : ndarray of float64, shape (N, 7) and (N, 15)
        Weights of the control points in that ball's centre and radius.
    centres_m : ndarray of float64, shape (N, 3)
        That ball's centre.
    share : ndarray of float64, shape (N,)
        Its position along the curve, 0 to 1.
    """

    gap_m: NDArray[np.float64]
    away: NDArray[np.float64]
    bend_basis: NDArray[np.float64]
    width_basis: NDArray[np.float64]
    centres_m: NDArray[np.float64]
    share: NDArray[np.float64]


@lru_cache(maxsize=8)
def bases(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Give the bases of centre and radius at evenly spaced places, (count, 7) and (count, 15)."""
    t = np.linspace(0.0, 1.0, count)
    return cubic_basis(t, BEND_SEGMENTS), cubic_basis(t, WIDTH_SEGMENTS)


def shape_from_curve(curve_m: NDArray[np.float64], radius_m: float) -> TubeShape:
    """Give the shape of even radius whose centres run along a polyline.

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
    >>> centres[:, [0, 2]].round(4).tolist(), radii.round(4).tolist()
    ([[0.0, 0.5], [0.1, 0.5], [0.2, 0.5]], [0.02, 0.02, 0.02])
    """
    basis = cubic_basis(np.linspace(0, 1, len(curve_m)), BEND_SEGMENTS)
    bend = np.linalg.lstsq(basis, curve_m, rcond=None)[0]
    return TubeShape(np.asarray(bend, dtype=np.float64), np.full(WIDTH_SEGMENTS + 3, radius_m))


def gaps(shape: TubeShape, readings: NDArray[np.float64], *, rays: bool) -> Gaps:
    """Measure how far readings are from a shape.

    Parameters
    ----------
    shape : TubeShape
        The body.
    readings : ndarray of float64, shape (N, 3)
        Points in metres, or unit directions of rays from the camera.
    rays : bool
        Which of the two.

    Returns
    -------
    Gaps
        Of each reading to its nearest ball.

    Examples
    --------
    >>> x = np.linspace(0, 0.2, 33)
    >>> shape = shape_from_curve(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), 0.02)
    >>> gaps(shape, np.array([[0.1, 0.0, 0.47]]), rays=False).gap_m.round(6).tolist()
    [0.01]

    A ray that touches the body's side at sin a = 0.02 / 0.5:

    >>> touching = np.array([[0.0, 0.04, np.sqrt(1 - 0.04**2)]])
    >>> bool(abs(gaps(shape, touching, rays=True).gap_m[0]) < 1e-9)
    True
    """
    centres, radii = shape.balls()
    along = readings @ centres.T
    squared = np.einsum("ij,ij->i", centres, centres)
    if rays:
        distance = np.sqrt(np.maximum(squared - along * along, 0.0))
    else:
        own = np.einsum("ij,ij->i", readings, readings)
        distance = np.sqrt(np.maximum(own[:, None] + squared - 2 * along, 0.0))
    distance -= radii
    index = np.rint(_lowest(distance) * (FINE / (BALLS - 1))).astype(np.intp)
    bend_table, width_table = bases(FINE + 1)
    bend, width = bend_table[index], width_table[index]
    centre = bend @ shape.bend_m
    if rays:
        away = centre - np.einsum("ij,ij->i", centre, readings)[:, None] * readings
    else:
        away = centre - readings
    far = np.maximum(np.sqrt(np.einsum("ij,ij->i", away, away)), 1e-9)
    away /= far[:, None]
    return Gaps(far - width @ shape.width_m, away, bend, width, centre, index / FINE)


def depth_gaps(
    shape: TubeShape, rays: NDArray[np.float64], far_m: NDArray[np.float64]
) -> tuple[Gaps, NDArray[np.float64]]:
    """Measure how far depth readings are from where their rays enter a shape.

    Parameters
    ----------
    shape : TubeShape
        The body.
    rays : ndarray of float64, shape (N, 3)
        Unit directions from the camera.
    far_m : ndarray of float64, shape (N,)
        Distance read along each.

    Returns
    -------
    found : Gaps
        `gap_m` is the distance along the ray times `facing`, positive before the surface; for
        a ray that misses the body or only grazes it, the point's own gap.
    facing : ndarray of float64, shape (N,)
        Cosine between the ray and the surface's normal where it enters.

    Examples
    --------
    >>> x = np.linspace(0, 0.2, 33)
    >>> shape = shape_from_curve(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), 0.02)
    >>> found, facing = depth_gaps(shape, np.array([[0.0, 0.0, 1.0]]), np.array([0.47]))
    >>> found.gap_m.round(6).tolist(), facing.round(6).tolist()
    ([0.01], [1.0])
    """
    centres, radii = shape.balls()
    along = rays @ centres.T
    inside = along * along + (radii * np.abs(radii) - np.einsum("ij,ij->i", centres, centres))
    entry = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0.0)), MISSED_M)
    # Between the balls the place is found by the entry point's distance, which stays smooth where
    # a ray grazes the body.
    nearest = np.argmin(entry, axis=1)
    first = entry[np.arange(len(rays)), nearest]
    nearest = np.clip(nearest, 1, BALLS - 2)
    three = nearest[:, None] + np.arange(-1, 2)
    off = centres[three] - (first[:, None] * rays)[:, None, :]
    distance = np.sqrt(np.einsum("ijk,ijk->ij", off, off)) - radii[three]
    place = nearest - 1 + _lowest(distance)
    index = np.rint(place * (FINE / (BALLS - 1))).astype(np.intp)
    bend_table, width_table = bases(FINE + 1)
    bend, width = bend_table[index], width_table[index]
    centre = bend @ shape.bend_m
    radius = np.maximum(width @ shape.width_m, 1e-4)
    along_one = np.einsum("ij,ij->i", centre, rays)
    beside = np.einsum("ij,ij->i", centre, centre) - along_one**2
    facing = np.sqrt(np.clip(1 - beside / radius**2, 0.0, 1.0))
    at = along_one - facing * radius
    away = (centre - at[:, None] * rays) / radius[:, None]
    gap = (at - far_m) * facing
    missed = np.flatnonzero(facing <= GRAZING)
    if len(missed):
        own = gaps(shape, rays[missed] * far_m[missed, None], rays=False)
        gap[missed], away[missed], centre[missed] = own.gap_m, own.away, own.centres_m
        bend[missed], width[missed] = own.bend_basis, own.width_basis
        index[missed] = np.rint(own.share * FINE)
    return Gaps(gap, away, bend, width, centre, index / FINE), facing


def _lowest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    # Position of each row's minimum, by a parabola through the lowest value and its neighbours.
    last = values.shape[1] - 1
    k = np.clip(np.argmin(values, axis=1), 1, last - 1)
    rows = np.arange(len(values))
    a, b, c = values[rows, k - 1], values[rows, k], values[rows, k + 1]
    curve = a - 2 * b + c
    step = np.where(curve > 1e-12, 0.5 * (a - c) / np.maximum(curve, 1e-12), np.sign(a - c))
    return np.asarray(np.clip(k + np.clip(step, -1.0, 1.0), 0, last))
