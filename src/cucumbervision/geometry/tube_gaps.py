"""Distances of readings from a union of balls along a smooth curve.

A depth point should lie on the body, min over s of |P - C(s)| - r(s) = 0, and a ray through the
outline should just touch it, min over s of dist(ray, C(s)) - r(s) = 0, which is exact in
perspective, at any tilt, round the ends as well as along the sides. Both minima are taken at the
nearest ball, where the derivative by s vanishes, so Gauss-Newton needs only that ball's centre
and radius.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry import tube_kernel
from cucumbervision.geometry.tube import BALLS, TubeShape, bases
from cucumbervision.geometry.tube_kernel import FINE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.geometry.tube_kernel import Contacts

_GRAZING = 0.2  # the cosine below which a ray only grazes the body
_MISSED_M = 100.0


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


def gaps_of(found: Contacts) -> Gaps:
    """Return the gaps that the compiled kernel found."""
    bend, width = (table.take(found.index, axis=0) for table in bases(FINE + 1))
    return Gaps(found.gap_m, found.away, bend, width, found.centres_m, found.index / FINE)


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
    >>> from cucumbervision.geometry.tube import shape_from_curve
    >>> x = np.linspace(0, 0.2, 33)
    >>> shape = shape_from_curve(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), 0.02)
    >>> gaps(shape, np.array([[0.1, 0.0, 0.47]]), rays=False).gap_m.round(6).tolist()
    [0.01]

    A ray that touches the body's side at sin a = 0.02 / 0.5:

    >>> touching = np.array([[0.0, 0.04, np.sqrt(1 - 0.04**2)]])
    >>> bool(abs(gaps(shape, touching, rays=True).gap_m[0]) < 1e-9)
    True
    """
    if (found := tube_kernel.gaps(shape, readings, rays=rays)) is not None:
        return gaps_of(found)
    centres, radii = shape.balls()
    distance = readings @ centres.T
    squared = np.einsum("ij,ij->i", centres, centres)
    if rays:
        distance *= distance
        np.subtract(squared, distance, out=distance)
    else:
        distance *= -2.0
        distance += squared
        distance += np.einsum("ij,ij->i", readings, readings)[:, None]
    np.maximum(distance, 0.0, out=distance)
    np.sqrt(distance, out=distance)
    distance -= radii
    index, bend, width, centre = _ball_at(shape, _lowest(distance))
    if rays:
        away = centre - np.einsum("ij,ij->i", centre, readings)[:, None] * readings
    else:
        away = centre - readings
    norm = np.maximum(np.sqrt(np.einsum("ij,ij->i", away, away)), 1e-9)
    away /= norm[:, None]
    return Gaps(norm - width @ shape.width_m, away, bend, width, centre, index / FINE)


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
    contacts : Gaps
        `gap_m` is the distance along the ray times `facing`, positive before the surface; for
        a ray that misses the body or only grazes it, the point's own gap.
    facing : ndarray of float64, shape (N,)
        Cosine between the ray and the surface's normal where it enters.

    Examples
    --------
    >>> from cucumbervision.geometry.tube import shape_from_curve
    >>> x = np.linspace(0, 0.2, 33)
    >>> shape = shape_from_curve(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), 0.02)
    >>> contacts, facing = depth_gaps(shape, np.array([[0.0, 0.0, 1.0]]), np.array([0.47]))
    >>> contacts.gap_m.round(6).tolist(), facing.round(6).tolist()
    ([0.01], [1.0])
    """
    if (found := tube_kernel.depth_gaps(shape, rays, far_m)) is not None:
        return gaps_of(found), found.facing
    centres, radii = shape.balls()
    nearest, first = _entered(rays, centres, radii)
    # Between the balls the place is found by the entry point's distance, which stays smooth where
    # a ray grazes the body.
    nearest = np.minimum(np.maximum(nearest, 1), BALLS - 2)
    three = nearest[:, None] + np.arange(-1, 2)
    off = centres.take(three, axis=0) - (first[:, None] * rays)[:, None, :]
    distance = np.sqrt(np.einsum("ijk,ijk->ij", off, off)) - radii.take(three)
    index, bend, width, centre = _ball_at(shape, nearest + _vertex(*distance.T))
    radius = np.maximum(width @ shape.width_m, 1e-4)
    along_one = np.einsum("ij,ij->i", centre, rays)
    squared = np.einsum("ij,ij->i", centre, centre) - along_one**2
    facing = np.sqrt(np.minimum(np.maximum(1 - squared / radius**2, 0.0), 1.0))
    entry = along_one - facing * radius
    away = (centre - entry[:, None] * rays) / radius[:, None]
    gap = (entry - far_m) * facing
    missed = np.flatnonzero(facing <= _GRAZING)
    if len(missed):
        points = gaps(shape, rays[missed] * far_m[missed, None], rays=False)
        gap[missed], away[missed], centre[missed] = points.gap_m, points.away, points.centres_m
        bend[missed], width[missed] = points.bend_basis, points.width_basis
        index[missed] = np.rint(points.share * FINE)
    return Gaps(gap, away, bend, width, centre, index / FINE), facing


def _entered(
    rays: NDArray[np.float64], centres: NDArray[np.float64], radii: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    # The ball that each ray enters first, and how far away; _MISSED_M where it enters none.
    entry = rays @ centres.T
    inside = entry * entry
    inside += radii * np.abs(radii) - np.einsum("ij,ij->i", centres, centres)
    hit = inside > 0
    np.sqrt(inside, out=inside, where=hit)
    entered = np.full(entry.shape, _MISSED_M)
    np.subtract(entry, inside, out=entered, where=hit)
    nearest = np.argmin(entered, axis=1)
    return nearest, entered[np.arange(len(rays)), nearest]


def _ball_at(
    shape: TubeShape, ball: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    # Index among FINE positions, bases of centre and radius, and centre, at a fractional ball.
    index = np.rint(ball * (FINE / (BALLS - 1))).astype(np.intp)
    bend, width = (table.take(index, axis=0) for table in bases(FINE + 1))
    return index, bend, width, bend @ shape.bend_m


def _lowest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    # Position of each row's minimum, by a parabola through the lowest value and its neighbours.
    count = values.shape[1]
    k = np.minimum(np.maximum(np.argmin(values, axis=1), 1), count - 2)
    middle = np.arange(0, values.size, count) + k
    return np.asarray(
        k + _vertex(values.take(middle - 1), values.take(middle), values.take(middle + 1))
    )


def _vertex(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.float64]:
    # Where the parabola through three neighbours is lowest, from the middle one: -1 to 1.
    curve = a - 2 * b + c
    step = np.where(curve > 1e-12, 0.5 * (a - c) / np.maximum(curve, 1e-12), np.sign(a - c))
    return np.asarray(np.minimum(np.maximum(step, -1.0), 1.0))
