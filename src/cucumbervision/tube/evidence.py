"""What was seen of a fruit: medians of readings, the outline, and how far it lies from a tube."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.arrays import Array, Ints, Mask, Numbers
from cucumbervision.tube.shape import BALLS, BEND_SEGMENTS, FINE, WIDTH_SEGMENTS, TubeShape, bases

_STEPS_PX = np.array([0.5, 1.5, 2.5, 3.5])  # how far across an outline its depth is read
_GRAZING = 0.2  # the cosine below which a ray only grazes the body
_MISSED_M = 100.0


def quick_median(values: NDArray[np.floating[Any]]) -> float:
    """Return the median of a few numbers in a fifth of the time of `numpy.median`.

    Parameters
    ----------
    values : ndarray of float, shape (N,)
        At least one, none of them NaN.

    Examples
    --------
    >>> quick_median(np.array([4.0, 1.0, 3.0])), quick_median(np.array([4.0, 1.0]))
    (3.0, 2.5)
    """
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    return float(np.partition(values, (half - 1, half))[half - 1 : half + 1].mean())


def valid_median(values: Numbers, valid: Mask, axis: int = 0) -> Numbers:
    """Return the median along an axis over the valid entries only.

    Parameters
    ----------
    values : ndarray of float
        Any shape.
    valid : ndarray of bool
        The shape of `values`; False where an entry does not count.
    axis : int
        The axis that vanishes.

    Returns
    -------
    ndarray of float
        The dtype of `values`; NaN where no entry is valid. An even count gives the mean of the
        two middle entries.

    Examples
    --------
    >>> values = np.array([[1.0, 9.0, 2.0, 4.0], [3.0, 3.0, 3.0, 3.0]])
    >>> valid = np.array([[True, False, True, True], [False] * 4])
    >>> valid_median(values, valid, axis=1)
    array([ 2., nan])
    """
    # Invalid entries sort to the end, so the middle of the valid ones is found by their count.
    ordered = np.sort(np.where(valid, values, np.inf), axis=axis)
    count = valid.sum(axis=axis, keepdims=True)
    lower = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    upper = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis)
    with np.errstate(invalid="ignore"):  # inf - inf where nothing is valid
        middle = lower + (upper - lower) / 2
    return np.where(count > 0, middle, np.nan).squeeze(axis).astype(values.dtype)


def outline_cracks(mask: Mask) -> tuple[Array, Array]:
    """Return the points between a pixel of the mask and a neighbour outside it.

    A body's true outline runs somewhere between the two pixels' centres, so their middle is
    unbiased, which a contour through pixel centres is not (it lies half a pixel inside).

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Beyond its border nothing is known: no point is given there.

    Returns
    -------
    points_px : ndarray of float64, shape (N, 2)
        u, v; one of them half-integer.
    outward : ndarray of float64, shape (N, 2)
        Unit step from the mask's pixel to the other.

    Examples
    --------
    >>> mask = np.zeros((3, 4), bool)
    >>> mask[1, 1:3] = True
    >>> points, outward = outline_cracks(mask)
    >>> points[:2].tolist(), outward[:2].tolist()
    ([[0.5, 1.0], [2.5, 1.0]], [[-1.0, 0.0], [1.0, 0.0]])
    """
    v, u = np.nonzero(mask[:, 1:] != mask[:, :-1])
    across = np.where(mask[v, u], 1.0, -1.0)
    y, x = np.nonzero(mask[1:] != mask[:-1])
    below = np.where(mask[y, x], 1.0, -1.0)
    points = np.concatenate([np.stack([u + 0.5, v], axis=1), np.stack([x, y + 0.5], axis=1)])
    outward = np.concatenate(
        [np.stack([across, np.zeros(len(u))], axis=1), np.stack([np.zeros(len(x)), below], axis=1)]
    )
    return points, outward


def depth_across(depth_m: Numbers, points_px: Numbers, outward: Numbers) -> Array:
    """Return the median depth on one side of outline points.

    Parameters
    ----------
    depth_m : ndarray of float, shape (H, W)
        0 where there is no reading.
    points_px, outward : ndarray of float, shape (N, 2)
        Points and unit steps; negate the steps to look inward.

    Returns
    -------
    ndarray of float64, shape (N,)
        Median of the readings; NaN where there is none.

    Examples
    --------
    >>> depth = np.array([[0.5, 0.5, 0.9, 0.0, 0.9]])
    >>> edge, right = np.array([[1.5, 0.0]]), np.array([[1.0, 0.0]])
    >>> depth_across(depth, edge, right).tolist(), depth_across(depth, edge, -right).tolist()
    ([0.9], [0.5])
    """
    height, width = depth_m.shape
    places_px = points_px[:, None, :] + outward[:, None, :] * _STEPS_PX[:, None]
    pixel = np.rint(places_px).astype(np.intp)
    u, v = pixel[..., 0], pixel[..., 1]
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    z = depth_m[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    return valid_median(z, inside & (z > 0), axis=1)


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

    gap_m: Array
    away: Array
    bend_basis: Array
    width_basis: Array
    centres_m: Array
    share: Array


def gaps(shape: TubeShape, readings: Array, *, rays: bool) -> Gaps:
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
    >>> from cucumbervision.tube.shape import shape_from_curve
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


def depth_gaps(shape: TubeShape, rays: Array, far_m: Array) -> tuple[Gaps, Array]:
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
    >>> from cucumbervision.tube.shape import shape_from_curve
    >>> x = np.linspace(0, 0.2, 33)
    >>> shape = shape_from_curve(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), 0.02)
    >>> contacts, facing = depth_gaps(shape, np.array([[0.0, 0.0, 1.0]]), np.array([0.47]))
    >>> contacts.gap_m.round(6).tolist(), facing.round(6).tolist()
    ([0.01], [1.0])
    """
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


def _entered(rays: Array, centres: Array, radii: Array) -> tuple[Ints, Array]:
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


def _ball_at(shape: TubeShape, ball: Array) -> tuple[Ints, Array, Array, Array]:
    # Index among FINE positions, bases of centre and radius, and centre, at a fractional ball.
    index = np.rint(ball * (FINE / (BALLS - 1))).astype(np.intp)
    bend, width = (table.take(index, axis=0) for table in bases(FINE + 1))
    return index, bend, width, bend @ shape.bend_m


def _lowest(values: Array) -> Array:
    # Position of each row's minimum, by a parabola through the lowest value and its neighbours.
    count = values.shape[1]
    k = np.minimum(np.maximum(np.argmin(values, axis=1), 1), count - 2)
    middle = np.arange(0, values.size, count) + k
    return np.asarray(
        k + _vertex(values.take(middle - 1), values.take(middle), values.take(middle + 1))
    )


def _vertex(a: Array, b: Array, c: Array) -> Array:
    # Where the parabola through three neighbours is lowest, from the middle one: -1 to 1.
    curve = a - 2 * b + c
    step = np.where(curve > 1e-12, 0.5 * (a - c) / np.maximum(curve, 1e-12), np.sign(a - c))
    return np.asarray(np.minimum(np.maximum(step, -1.0), 1.0))


SLIPS = 3  # shifts of the whole outline: along x and y, and outward
_BENDS = 3 * (BEND_SEGMENTS + 3)
SHAPE = _BENDS + WIDTH_SEGMENTS + 3
BODY = SHAPE + SLIPS  # unknowns of body and outline
_TUKEY, _CAUCHY = 4.685, 2.385  # tuning constants for 95 % efficiency (Huber 1981; Holland 1977)
_TIP_COSINE, _TIP_RAYS, _LEAST_FORESHORTENED = 0.7, 2, 0.5
_OVERHANG_ERRORS = 3.0  # less than this many standard errors beyond an end is taken for none
_GROUND_M = 0.0003  # deviation of the skin from a smooth body: warts, ribs
_ACROSS = 0.3  # a depth reading's position across, in units of the outline's error
_MISFIT_SD = 5.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """Depth and outline of one fruit.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Depth points in camera coordinates, metres.
    points_sd_m : ndarray of float64, shape (N,)
        Standard deviation of their depth, metres.
    rays : ndarray of float64, shape (M, 3)
        Unit directions through the outline.
    rays_sd_rad : float
        Their standard deviation across, radians.
    pixel_rad : float
        Size of a pixel, radians.
    points_share, rays_share : float
        Number of independent readings that each counts for, at most 1, because errors of
        neighbouring pixels are correlated.
    waves_m : ndarray of float64, shape (N, W), optional
        Effect of waves of depth noise, longer than `points_share` covers, on each point's depth,
        metres along its ray, for amplitudes of standard deviation 1, which are fitted.
    """

    points_m: Array
    points_sd_m: Array
    rays: Array
    rays_sd_rad: float
    pixel_rad: float
    points_share: float
    rays_share: float
    waves_m: Array | None = None

    @property
    def waves(self) -> int:
        """Number of fitted waves of depth noise."""
        return 0 if self.waves_m is None else self.waves_m.shape[1]

    @cached_property
    def directions(self) -> Array:
        """Unit directions to the depth points, shape (N, 3)."""
        return np.asarray(self.points_m / self.points_far_m[:, None], dtype=np.float64)

    @cached_property
    def points_far_m(self) -> Array:
        """Distances of the depth points from the camera, shape (N,), metres."""
        return np.asarray(np.linalg.norm(self.points_m, axis=1), dtype=np.float64)

    @cached_property
    def far_m(self) -> float:
        """Median distance of the depth points, metres."""
        return float(np.median(self.points_far_m))


@dataclass(frozen=True, eq=False)
class Readings:
    """One kind of readings against a body.

    Parameters
    ----------
    contacts : Gaps
        Their gaps, metres.
    sd_m : ndarray of float64, shape (N,)
        The gaps' standard deviations, metres.
    slope : ndarray of float64, shape (N, K)
        The gaps' derivatives by the first K unknowns: `BODY` of them for the outline, and the
        waves too for depth points.
    """

    contacts: Gaps
    sd_m: Array
    slope: Array

    def misfit(self, share: float) -> float:
        """Return the sum of squared gaps in their own errors, each up to `_MISFIT_SD`."""
        errors = np.minimum(np.abs(self.contacts.gap_m / self.sd_m), _MISFIT_SD)
        return share * float((errors**2).sum())

    def scatter(self, limits: tuple[float, float]) -> float:
        """Return the robust scatter of the gaps relative to their errors, within limits."""
        if not len(self.sd_m):
            return 1.0
        spread = 1.4826 * quick_median(np.abs(self.contacts.gap_m / self.sd_m))
        return min(max(spread, limits[0]), limits[1])


def point_readings(evidence: Evidence, shape: TubeShape, nuisance: Array) -> Readings:
    """Return the depth points against a body.

    Depth errors are along the ray, so the gap is measured along the ray and multiplied by the
    cosine with the surface normal. The distance to the surface would favour small radii.

    Parameters
    ----------
    evidence : Evidence
        What was seen.
    shape : TubeShape
        The body, camera coordinates.
    nuisance : ndarray of float64, shape (SLIPS + W,)
        The outline's shifts, which are not used here, and the amplitude of each wave.
    """
    contacts, facing = depth_gaps(shape, evidence.directions, evidence.points_far_m)
    across = _ACROSS * evidence.rays_sd_rad * evidence.points_m[:, 2]
    sd = np.sqrt((evidence.points_sd_m * facing) ** 2 + across**2 + _GROUND_M**2)
    slope = _slope(contacts, evidence.waves)
    slope[:, SHAPE:BODY] = 0.0
    if evidence.waves_m is None:
        return Readings(contacts, sd, slope)
    waves = np.multiply(evidence.waves_m, facing[:, None], out=slope[:, BODY:])
    return Readings(replace(contacts, gap_m=contacts.gap_m + waves @ nuisance[SLIPS:]), sd, slope)


def ray_readings(evidence: Evidence, shape: TubeShape, slip_m: Array) -> Readings:
    """Return the outline's rays against a body.

    Parameters
    ----------
    evidence : Evidence
        What was seen.
    shape : TubeShape
        The body, camera coordinates.
    slip_m : ndarray of float64, shape (SLIPS,)
        Shift of the outline relative to depth in x and y, and its excess width; metres at the
        fruit's distance.
    """
    contacts = gaps(shape, evidence.rays, rays=True)
    distance = np.sqrt(np.einsum("ij,ij->i", contacts.centres_m, contacts.centres_m))
    sd = np.hypot(evidence.rays_sd_rad * distance, _GROUND_M)
    slope = _slope(contacts, 0)
    by_far = distance / evidence.far_m
    slope[:, SHAPE : BODY - 1] = by_far[:, None] * contacts.away[:, :2]
    slope[:, BODY - 1] = -by_far
    slipped = replace(contacts, gap_m=contacts.gap_m + slope[:, SHAPE:] @ slip_m)
    return Readings(slipped, sd, slope)


def _slope(contacts: Gaps, waves: int) -> Array:
    # By the body; the rest is left to be filled in.
    slope = np.empty((len(contacts.gap_m), BODY + waves))
    for axis in range(3):
        away = contacts.away[:, axis : axis + 1]
        np.multiply(contacts.bend_basis, away, out=slope[:, axis:_BENDS:3])
    np.negative(contacts.width_basis, out=slope[:, _BENDS:SHAPE])
    return slope


def normal_equations(
    readings: tuple[Readings, Readings],
    shares: tuple[float, float],
    scatter: tuple[float, float],
    scale: float,
) -> tuple[Array, Array]:
    """Return the robustly weighted normal equations of depth points and outline.

    Depth points are weighted by Tukey's biweight (Beaton and Tukey 1974), rays by Cauchy's weight
    (Holland and Welsch 1977).

    Parameters
    ----------
    readings : tuple of Readings
        Of the points, with K unknowns, and of the rays, with the first of these.
    shares : tuple of float
        Number of independent readings that one of each kind counts for.
    scatter : tuple of float
        Scatter of each kind relative to its errors.
    scale : float
        Factor on the errors, above which a reading is an outlier.

    Returns
    -------
    normal : ndarray of float64, shape (K, K)
        1/m².
    target : ndarray of float64, shape (K,)
        1/m: product of `normal` and the step.
    """
    size = readings[0].slope.shape[1]  # the outline knows of no depth noise: it has fewer
    normal, target = np.zeros((size, size)), np.zeros(size)
    # Errors of a rough outline are correlated over longer runs: fewer independent readings.
    shares = shares[0], shares[1] / max(1.0, scatter[1]) ** 2
    for kind, by, share, trust in zip(readings, scatter, shares, (_tukey, _cauchy), strict=True):
        error = kind.sd_m * by * scale
        gap = kind.contacts.gap_m / error
        root = np.sqrt(share * trust(gap))
        weighted = kind.slope * (root / error)[:, None]
        columns = slice(0, kind.slope.shape[1])
        normal[columns, columns] += weighted.T @ weighted
        target[columns] -= (root * gap) @ weighted
    return normal, target


def _tukey(u: Array) -> Array:
    inside = np.maximum(1 - (u / _TUKEY) ** 2, 0.0)
    return inside * inside


def _cauchy(u: Array) -> Array:
    return 1 / (1 + (u / _CAUCHY) ** 2)


def ends_seen(shape: TubeShape, contacts: Gaps, rays: Array) -> tuple[bool, bool]:
    """Return whether the outline surrounds a body's first and last end.

    There it touches the outer side of the last ball.

    Parameters
    ----------
    shape : TubeShape
        The body, camera coordinates.
    contacts : Gaps
        Of the outline's rays.
    rays : ndarray of float64, shape (M, 3)
        Unit directions through the outline.
    """
    first, last = (len(overhangs) >= _TIP_RAYS for overhangs in _beyond_ends(shape, contacts, rays))
    return first, last


def end_overhangs(shape: TubeShape, contacts: Gaps, rays: Array) -> tuple[float, float]:
    """Return how far the outline goes beyond a body's first and last end, metres.

    Balls do not fill a pointed end. At most the body's median radius; 0 where the outline does not
    surround the end or is not significantly beyond it. Parameters as those
    of `ends_seen`.
    """
    limit = quick_median(shape.width_m)
    first, last = map(_overhang, _beyond_ends(shape, contacts, rays))
    return min(first, limit), min(last, limit)


def _overhang(beyond_m: Array) -> float:
    if len(beyond_m) <= _TIP_RAYS:
        return 0.0
    median = quick_median(beyond_m)
    scatter = 1.4826 * quick_median(np.abs(beyond_m - median))
    error = 1.2533 * scatter / np.sqrt(len(beyond_m))  # of a median of normal errors
    return median if median > _OVERHANG_ERRORS * error else 0.0


def _beyond_ends(shape: TubeShape, contacts: Gaps, rays: Array) -> list[Array]:
    # Positions along the axis of the rays that touch the outer side of each end's ball.
    overhangs = []
    centres, _ = shape.balls()
    for share, tip, inner in ((0.0, 0, 1), (1.0, -1, -2)):
        at_end = np.abs(contacts.share - share) < 0.5 / BALLS
        tangent = centres[tip] - centres[inner]
        ray = rays[at_end]
        ahead = tangent - (ray @ tangent)[:, None] * ray
        norm = np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)
        cosine = -np.einsum("ij,ij->i", ahead, contacts.away[at_end]) / norm
        foreshortened = np.maximum(norm / np.linalg.norm(tangent), _LEAST_FORESHORTENED)
        overhang = contacts.gap_m[at_end] * cosine / foreshortened
        overhangs.append(overhang[cosine > _TIP_COSINE])
    return overhangs
