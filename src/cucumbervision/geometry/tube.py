"""A tube about a curved axis: its shape, its lengths, and a first guess of it from points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.geometry.axis import principal_axis

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "BALLS",
    "BEND_SEGMENTS",
    "Gaps",
    "TubeShape",
    "arc_positions",
    "axis_path",
    "bases",
    "bending_direction",
    "cubic_basis",
    "cubic_basis_slope",
    "depth_gaps",
    "differences",
    "gaps",
    "guess_shape",
    "inner_arc_height",
    "near_depths",
    "points_along",
    "profile",
    "shape_from_curve",
    "thread_length",
    "volume_of_profile",
]


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


CAP_STEPS = 40

SWALLOWED_M = 1e-5


def arc_positions(centres_m: NDArray[Any]) -> NDArray[np.float64]:
    """Give each centre's arc length from the first, metres.

    Examples
    --------
    >>> arc_positions(np.array([[0.0, 0, 0], [3.0, 4.0, 0], [3.0, 4.0, 2.0]])).tolist()
    [0.0, 5.0, 7.0]
    """
    steps = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def points_along(vertices: NDArray[Any], shares: ArrayLike) -> NDArray[np.float64]:
    """Give the points of a polyline at shares of its length.

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
    at = np.asarray(shares) * run[-1]
    return np.stack([np.interp(at, run, column) for column in np.asarray(vertices).T], axis=1)


def axis_path(centres_m: NDArray[Any], radii_m: NDArray[Any]) -> NDArray[np.float64]:
    """Give the central axis from pole to pole.

    Parameters
    ----------
    centres_m : ndarray of float, shape (K, 3)
        Centres in order.
    radii_m : ndarray of float, shape (K,)
        Their radii.

    Returns
    -------
    ndarray of float64, shape (K' + 2, 3)
        Poles and the centres between them. A ball that another ball swallows reaches no further
        than that one, so the poles lie where the farthest-reaching ball ends.

    Examples
    --------
    >>> centres = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    >>> axis_path(centres, np.full(3, 0.02))[[0, -1], 0].round(3).tolist()
    [-0.02, 0.22]
    """
    kept, radii = _reaching(centres_m, radii_m)
    start = _unit(kept[1] - kept[0])
    end = _unit(kept[-1] - kept[-2])
    return np.vstack([kept[0] - radii[0] * start, kept, kept[-1] + radii[-1] * end])


def bending_direction(axis_m: NDArray[Any]) -> NDArray[np.float64]:
    """Give the unit vector from the chord towards the convex side, in the plane of bending.

    Parameters
    ----------
    axis_m : ndarray of float, shape (K, 3)
        The axis, end to end.

    Returns
    -------
    ndarray of float64, shape (3,)
        Perpendicular to the chord; for a straight axis any such vector.

    Examples
    --------
    >>> t = np.linspace(0, np.pi, 99)
    >>> bending_direction(np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)).round(6).tolist()
    [0.0, 1.0, 0.0]
    """
    chord = _unit(axis_m[-1] - axis_m[0])
    off = axis_m - axis_m[0]
    off = off - (off @ chord)[:, None] * chord
    steps = np.linalg.norm(np.diff(axis_m, axis=0), axis=1)
    mean = (0.5 * (off[1:] + off[:-1]) * steps[:, None]).sum(axis=0)
    if np.linalg.norm(mean) < 1e-9 * steps.sum() ** 2:
        mean = np.cross(chord, np.eye(3)[np.argmin(np.abs(chord))])
    return _unit(mean)


def thread_length(centres_m: NDArray[Any], radii_m: NDArray[Any], outward: NDArray[Any]) -> float:
    """Give the length of a thread laid from pole to pole over the convex side.

    Parameters
    ----------
    centres_m : ndarray of float, shape (K, 3)
        Centres in order.
    radii_m : ndarray of float, shape (K,)
        Their radii.
    outward : ndarray of float, shape (3,)
        Unit vector towards the convex side (`bending_direction`).

    Returns
    -------
    float
        Metres: along the balls' envelope on that side, and over each end from the envelope's
        last contact to the pole.

    Examples
    --------
    A straight body of radius r with its end centres a apart: a + pi r.

    >>> x = np.linspace(0, 0.2, 101)
    >>> centres = np.stack([x, 0 * x, 0 * x], axis=1)
    >>> length = thread_length(centres, np.full(101, 0.02), np.array([0.0, 1.0, 0.0]))
    >>> round(length, 6), round(0.2 + np.pi * 0.02, 6)
    (0.262828, 0.262832)
    """
    centres, radii = _reaching(centres_m, radii_m)
    contact, slope, tangents, across = _contacts(centres, radii, outward)
    last = len(radii) - 1
    caps = []
    for end, sign, angle in ((0, -1.0, np.arccos(slope[0])), (last, 1.0, np.arccos(-slope[-1]))):
        turn = np.linspace(0.0, angle, CAP_STEPS)[:, None]
        step = sign * np.cos(turn) * tangents[end] + np.sin(turn) * across[end]
        caps.append(centres[end] + radii[end] * step)
    line = np.vstack([caps[0], contact[1:-1], caps[1][::-1]])
    # Where a ball is swallowed by others its contact lies inside the body: no thread runs there.
    gap = np.sqrt(_squared_distances(line, centres)) - radii
    line = line[gap.min(axis=1) > -SWALLOWED_M]
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) if len(line) > 1 else 0.0


def inner_arc_height(
    centres_m: NDArray[Any], radii_m: NDArray[Any], poles_m: NDArray[Any], outward: NDArray[Any]
) -> float:
    """Give the largest distance from the chord to the body's inner edge.

    Parameters
    ----------
    centres_m, radii_m : ndarray of float, shape (K, 3) and (K,)
        The body.
    poles_m : ndarray of float, shape (2, 3)
        The ends of the chord.
    outward : ndarray of float, shape (3,)
        Unit vector towards the convex side.

    Returns
    -------
    float
        Metres; 0 where the inner edge does not rise above the chord.

    Examples
    --------
    An arc of radius 0.2 over a half turn, 0.02 thick: its inner edge rises to 0.18 less what the
    round ends' poles lie below the centres' ends.

    >>> t = np.linspace(0, np.pi, 200)
    >>> centres = 0.2 * np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    >>> poles = np.array([[0.2, -0.02, 0], [-0.2, -0.02, 0]])
    >>> up = np.array([0.0, 1.0, 0.0])
    >>> round(inner_arc_height(centres, np.full(200, 0.02), poles, up), 4)
    0.2
    """
    inner, _, _, _ = _contacts(centres_m, radii_m, -outward)
    return max(0.0, float(((inner - poles_m[0]) @ outward).max()))


def profile(
    centres_m: NDArray[Any], radii_m: NDArray[Any], samples: int = 101
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Give the body's diameter along its axis from pole to pole.

    Parameters
    ----------
    centres_m : ndarray of float, shape (K, 3)
        Centres in order.
    radii_m : ndarray of float, shape (K,)
        Their radii.
    samples : int
        Number of cross-sections.

    Returns
    -------
    along_m, diameter_m : ndarray of float64, shape (samples,)
        Position along the axis from the first pole, and the cross-section's diameter there: the
        widest of the balls' sections, the body being taken as straightened.

    Examples
    --------
    >>> x = np.linspace(0, 0.2, 201)
    >>> along, wide = profile(np.stack([x, 0 * x, 0 * x], axis=1), np.full(201, 0.02), 5)
    >>> along.round(3).tolist(), wide.round(3).tolist()
    ([0.0, 0.06, 0.12, 0.18, 0.24], [0.0, 0.04, 0.04, 0.04, 0.0])
    """
    at = arc_positions(centres_m)
    radii = np.maximum(radii_m, 0.0)
    low, high = float((at - radii).min()), float((at + radii).max())
    along = np.linspace(low, high, samples)
    half = radii**2 - (along[:, None] - at) ** 2
    return along - low, 2 * np.sqrt(np.maximum(half.max(axis=1), 0.0))


def volume_of_profile(along_m: NDArray[Any], diameter_m: NDArray[Any]) -> float:
    """Give the volume of a body of round cross-sections, cubic metres.

    By Pappus a bend changes nothing, so long as the sections are centred on the axis.

    Examples
    --------
    >>> volume_of_profile(np.array([0.0, 1.0]), np.array([2.0, 2.0])) == np.pi
    True
    """
    return float(np.trapezoid(np.pi / 4 * np.asarray(diameter_m) ** 2, along_m))


def _reaching(
    centres_m: NDArray[Any], radii_m: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # The balls between the two that reach farthest along the axis: beyond them all is swallowed.
    along, radii = arc_positions(centres_m), np.maximum(radii_m, 0.0)
    first, last = int(np.argmin(along - radii)), int(np.argmax(along + radii))
    if last <= first:
        first, last = 0, len(along) - 1
    kept = np.asarray(centres_m[first : last + 1], dtype=np.float64)
    return kept, np.asarray(radii[first : last + 1], dtype=np.float64)


def _contacts(
    centres_m: NDArray[Any], radii_m: NDArray[Any], side: NDArray[Any]
) -> tuple[NDArray[np.float64], ...]:
    # Where each ball touches the common envelope on one side; the radius' slope, the tangent and
    # the perpendicular towards that side there.
    tangents = np.gradient(np.asarray(centres_m, dtype=np.float64), axis=0)
    speed = np.maximum(np.linalg.norm(tangents, axis=1), 1e-12)
    tangents /= speed[:, None]
    across = side - (tangents @ side)[:, None] * tangents
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None]
    slope = np.clip(np.gradient(np.asarray(radii_m, dtype=np.float64)) / speed, -1.0, 1.0)
    lean = slope[:, None]
    touch = -lean * tangents + np.sqrt(1 - lean**2) * across
    return centres_m + radii_m[:, None] * touch, slope, tangents, across


def _squared_distances(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    square = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.maximum(square, 0.0))


def _unit(vector: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), dtype=np.float64)


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
