"""Fit a union of balls along a smooth curve to depth points and outline rays together.

Each reading is compared with the body's own geometry: a depth point should lie on the union of
balls, min over s of |P - C(s)| - r(s) = 0, and a ray through the outline should just touch it,
min over s of dist(ray, C(s)) - r(s) = 0, which is exact in perspective, at any tilt, round the
ends as well as along the sides. Both minima are taken at the nearest ball, where the derivative
by s vanishes, so Gauss-Newton needs only that ball's centre and radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.tube import BALLS, BEND_SEGMENTS, WIDTH_SEGMENTS, TubeShape, bases

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "Evidence",
    "Gaps",
    "TubeFitting",
    "depth_gaps",
    "fit_shape",
    "gaps",
]

FINE = 1024  # positions along the curve to which a nearest ball is rounded
GRAZING = 0.2  # the cosine below which a ray only grazes the body
MISSED_M = 100.0
# How much larger than its own each reading's error is taken to be, step by step.
SCHEDULE = (16.0, 10.0, 6.0, 4.0, 2.5, 1.6, 1.0, 1.0, 1.0)
MORE_STEPS, STILL_M = 6, 1e-4  # after these, until nothing moves by more
SETTLED = 6  # from this step on the outline's and the depth's own scatter is used
TUKEY, CAUCHY = 4.685, 2.385  # tuning constants for 95 % efficiency (Huber 1981; Holland 1977)
# What is believed of fruit before looking, in shares of the length L and the radius r.
TWIST_SD = 1.0  # the curvature's change k' over the length: k' L^2
BEND_SD, BEND_CHANGE_SD = 8.0, 100.0  # curvature k, 1/m, and its change along the fruit, 1/m^2
TILT_SD = 0.6  # the far end beyond the near one, along the view
SPEED_SD = 0.02  # a control point's distance to the next, from one to the next
WIDTH_SD = 0.05  # the radius' second difference; with heavy tails, so that shoulders may stand
WIDTH_TAIL = 1.0
# How far, in radii, an end may be from where it was guessed: one that the outline shows (where
# this must not matter), and one that a leaf or the picture's edge hides.
ANCHOR_SD, HIDDEN_ANCHOR_SD = 1.5, 0.15
TIP_COSINE, TIP_RAYS = 0.7, 2
GROUND_M = 0.0003  # what even a perfect reading may differ from a smooth body: warts, ribs
# Colour and depth are registered to about a pixel; masks are drawn too wide or too narrow. More
# room for the latter would win on masks 3 px too wide, but a real sensor's depth does not know a
# body's roundness well enough: on rigid bodies seen anew the length then wanders.
SLIP_SD_PX = (1.0, 1.0, 0.1)
SLIPS = len(SLIP_SD_PX)
BODY = 3 * (BEND_SEGMENTS + 3) + WIDTH_SEGMENTS + 3 + SLIPS  # unknowns of body and outline
ACROSS = 0.3  # a depth reading's position across, in units of the outline's error
LEAST_WIDTH = 0.15  # of the middle radius
LEAST_HOLD = 1e-9  # of the mean weight, on every unknown: nothing may be left quite free
MISFIT_SD = 5.0
SCATTER_RAYS, SCATTER_POINTS = (0.5, 2.0), (0.7, 3.0)


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
    centres, radii = shape.balls()
    along = readings @ centres.T
    squared = np.einsum("ij,ij->i", centres, centres)
    if rays:
        distance = np.sqrt(np.maximum(squared - along * along, 0.0))
    else:
        own = np.einsum("ij,ij->i", readings, readings)
        distance = np.sqrt(np.maximum(own[:, None] + squared - 2 * along, 0.0))
    distance -= radii
    index, bend, width, centre = _ball_at(shape, _lowest(distance))
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
    >>> from cucumbervision.geometry.tube import shape_from_curve
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
    index, bend, width, centre = _ball_at(shape, nearest - 1 + _lowest(distance))
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


def _ball_at(
    shape: TubeShape, ball: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    # Index among FINE positions, bases of centre and radius, and centre, at a fractional ball.
    index = np.rint(ball * (FINE / (BALLS - 1))).astype(np.intp)
    bend, width = (table[index] for table in bases(FINE + 1))
    return index, bend, width, bend @ shape.bend_m


def _lowest(values: NDArray[np.float64]) -> NDArray[np.float64]:
    # Position of each row's minimum, by a parabola through the lowest value and its neighbours.
    last = values.shape[1] - 1
    k = np.clip(np.argmin(values, axis=1), 1, last - 1)
    rows = np.arange(len(values))
    a, b, c = values[rows, k - 1], values[rows, k], values[rows, k + 1]
    curve = a - 2 * b + c
    step = np.where(curve > 1e-12, 0.5 * (a - c) / np.maximum(curve, 1e-12), np.sign(a - c))
    return np.asarray(np.clip(k + np.clip(step, -1.0, 1.0), 0, last))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was seen of one fruit.

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
        What a pixel spans, radians.
    points_share, rays_share : float
        How many independent readings one of them counts for, at most 1: neighbouring pixels
        err together.
    waves_m : ndarray of float64, shape (N, W), optional
        What waves of depth noise, longer than `points_share` allows for, do to each point's
        depth, metres along its ray: W unknowns of standard deviation 1 that are fitted along.
    """

    points_m: NDArray[np.float64]
    points_sd_m: NDArray[np.float64]
    rays: NDArray[np.float64]
    rays_sd_rad: float
    pixel_rad: float
    points_share: float
    rays_share: float
    waves_m: NDArray[np.float64] | None = None

    @property
    def waves(self) -> int:
        """How many waves of depth noise are fitted along."""
        return 0 if self.waves_m is None else self.waves_m.shape[1]

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """Unit directions to the depth points, shape (N, 3)."""
        return np.asarray(self.points_m / self.points_far_m[:, None], dtype=np.float64)

    @cached_property
    def points_far_m(self) -> NDArray[np.float64]:
        """Distances of the depth points from the camera, shape (N,), metres."""
        return np.asarray(np.linalg.norm(self.points_m, axis=1), dtype=np.float64)

    @cached_property
    def far_m(self) -> float:
        """Median distance of the depth points, metres."""
        return float(np.median(self.points_far_m))


@dataclass(frozen=True, eq=False)
class TubeFitting:
    """A fitted shape, and what remains.

    Parameters
    ----------
    shape : TubeShape
        The body.
    covariance : ndarray of float64, shape (39, 39)
        Of the shape's control points row by row, of its control radii, and of `slip_px` at the
        fruit's distance; square metres.
    points, rays : Gaps
        What remains at the depth points and at the outline's rays.
    ends_seen : tuple of bool
        Whether the outline goes round the curve's first and last end.
    misfit : float
        Squared gaps in units of their own error, each counted up to `MISFIT_SD`, as many as
        there are independent readings: what tells fits of one fruit from each other.
    """

    shape: TubeShape
    covariance: NDArray[np.float64]
    points: Gaps
    rays: Gaps
    ends_seen: tuple[bool, bool]
    misfit: float = 0.0

    @property
    def centreline_sd_m(self) -> float:
        """Standard deviation of the axis' length from pole to pole, metres."""
        bend, width = bases(BALLS)
        centres = bend @ self.shape.bend_m
        steps = np.diff(centres, axis=0)
        steps /= np.maximum(np.linalg.norm(steps, axis=1), 1e-12)[:, None]
        by_bend = np.diff(bend, axis=0).T @ steps
        slope = np.concatenate([by_bend.ravel(), width[0] + width[-1], np.zeros(SLIPS)])
        return float(np.sqrt(max(slope @ self.covariance @ slope, 0.0)))


def fit_shape(evidence: Evidence, guess: TubeShape) -> TubeFitting:
    """Fit the shape by robust Gauss-Newton steps, from coarse to fine.

    Depth points are weighted by Tukey's biweight (flying pixels must have no say), outline rays
    by Cauchy's weight (a stalk or a shoulder must keep some). Towards the end both kinds are
    rescaled by their own scatter, so that a rough outline trusts depth more, and the reverse.

    Parameters
    ----------
    evidence : Evidence
        What was seen.
    guess : TubeShape
        Where to start; its ends rather short of the fruit's than beyond.

    Returns
    -------
    TubeFitting
        The shape with its covariance, and what remains.

    Examples
    --------
    A straight body seen from the side: surface points of its front, and no outline.

    >>> from cucumbervision.geometry.tube import shape_from_curve
    >>> x, a = (m.ravel() for m in np.meshgrid(np.linspace(0, 0.2, 60), np.linspace(0.3, 2.8, 9)))
    >>> cloud = np.stack([x, 0.02 * np.cos(a), 0.5 - 0.02 * np.sin(a)], axis=1)
    >>> curve = np.stack([np.linspace(0.02, 0.18, 9), np.zeros(9), np.full(9, 0.505)], axis=1)
    >>> evidence = Evidence(cloud, np.full(540, 1e-3), np.empty((0, 3)), 1e-3, 1e-3, 1.0, 1.0)
    >>> centres, radii = fit_shape(evidence, shape_from_curve(curve, 0.015)).shape.balls(5)
    >>> centres[2, 2].round(3).tolist(), radii[2].round(3).tolist()
    (0.5, 0.02)
    """
    shape, beside = guess, np.zeros(SLIPS + evidence.waves)
    scatter, hold = (1.0, 1.0), np.full(2, ANCHOR_SD)
    anchors = guess.balls(2)[0]
    settled = False
    for step, scale in enumerate((*SCHEDULE, *[SCHEDULE[-1]] * MORE_STEPS)):
        if settled and step >= len(SCHEDULE):
            break
        points = look_at_points(evidence, shape, beside)
        rays = look_at_rays(evidence, shape, beside[:SLIPS])
        if step >= SETTLED:
            scatter = points.scatter(SCATTER_POINTS), rays.scatter(SCATTER_RAYS)
            seen = ends_seen_by(shape, rays.found, evidence.rays)
            hold = np.where(seen, ANCHOR_SD, HIDDEN_ANCHOR_SD)
        shares = evidence.points_share, evidence.rays_share
        normal, target = normal_equations((points, rays), shares, scatter, scale)
        add_shape_prior(normal, target, shape, anchors, hold)
        add_beside_prior(normal, target, beside, evidence)
        body = np.arange(BODY)
        normal[body, body] += LEAST_HOLD * float(normal[body, body].mean())
        move = np.asarray(np.linalg.solve(normal, target))
        settled = float(np.abs(move[: BODY - SLIPS]).max()) < STILL_M
        shape, beside = _moved(shape, beside, move)
    rays = look_at_rays(evidence, shape, beside[:SLIPS])
    points = look_at_points(evidence, shape, beside)
    misfit = sum(r.misfit(n) for r, n in zip((points, rays), shares, strict=True))
    points = look_at_points(evidence, shape, np.zeros(len(beside)))
    covariance = np.asarray(np.linalg.inv(normal)[:BODY, :BODY], dtype=np.float64)
    ends_seen = ends_seen_by(shape, rays.found, evidence.rays)
    return TubeFitting(shape, covariance, points.found, rays.found, ends_seen, misfit)


@dataclass(frozen=True, eq=False)
class _Readings:
    """One kind of readings against the present body: gaps, their errors, their derivatives."""

    found: Gaps
    sd_m: NDArray[np.float64]
    slope: NDArray[np.float64]

    def misfit(self, share: float) -> float:
        return share * float(
            (np.minimum(np.abs(self.found.gap_m / self.sd_m), MISFIT_SD) ** 2).sum()
        )

    def scatter(self, limits: tuple[float, float]) -> float:
        if not len(self.sd_m):
            return 1.0
        spread = 1.4826 * float(np.median(np.abs(self.found.gap_m / self.sd_m)))
        return min(max(spread, limits[0]), limits[1])


def ends_seen_by(shape: TubeShape, found: Gaps, rays: NDArray[np.float64]) -> tuple[bool, bool]:
    # Round an end the outline touches the last ball on its far side, as seen from the body.
    seen = []
    centres, _ = shape.balls()
    for share, tip, inner in ((0.0, 0, 1), (1.0, -1, -2)):
        at_end = np.abs(found.share - share) < 0.5 / BALLS
        tangent = centres[tip] - centres[inner]
        ray = rays[at_end]
        ahead = tangent - (ray @ tangent)[:, None] * ray
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
        touching = -np.einsum("ij,ij->i", ahead, found.away[at_end]) > TIP_COSINE
        seen.append(int(np.count_nonzero(touching)) >= TIP_RAYS)
    return seen[0], seen[1]


def look_at_points(evidence: Evidence, shape: TubeShape, beside: NDArray[np.float64]) -> _Readings:
    # Depth errs along its ray, so the gap is the one along the ray, times how squarely that
    # meets the surface. A gap across the surface, taken at the erring point, favours small radii.
    found, facing = depth_gaps(shape, evidence.directions, evidence.points_far_m)
    across = ACROSS * evidence.rays_sd_rad * evidence.points_m[:, 2]
    sd = np.sqrt((evidence.points_sd_m * facing) ** 2 + across**2 + GROUND_M**2)
    none = np.zeros((len(sd), SLIPS))
    if evidence.waves_m is None:
        return _Readings(found, sd, _slope(found, none))
    waves = evidence.waves_m * facing[:, None]
    calmed = replace(found, gap_m=found.gap_m + waves @ beside[SLIPS:])
    return _Readings(calmed, sd, _slope(found, np.hstack([none, waves])))


def look_at_rays(evidence: Evidence, shape: TubeShape, slip_m: NDArray[np.float64]) -> _Readings:
    found = gaps(shape, evidence.rays, rays=True)
    far = np.sqrt(np.einsum("ij,ij->i", found.centres_m, found.centres_m))
    sd = np.hypot(evidence.rays_sd_rad * far, GROUND_M)
    # The whole outline may lie beside the depth picture's, and too wide or too narrow.
    slip = (far / evidence.far_m)[:, None] * np.column_stack(
        [found.away[:, :2], np.full(len(far), -1.0)]
    )
    slipped = replace(found, gap_m=found.gap_m + slip @ slip_m)
    return _Readings(slipped, sd, _slope(found, slip))


def _slope(found: Gaps, slip: NDArray[np.float64]) -> NDArray[np.float64]:
    by_bend = found.bend_basis[:, :, None] * found.away[:, None, :]
    return np.concatenate(
        [by_bend.reshape(len(slip), 3 * found.bend_basis.shape[1]), -found.width_basis, slip],
        axis=1,
    )


def normal_equations(
    readings: tuple[_Readings, _Readings],
    shares: tuple[float, float],
    scatter: tuple[float, float],
    scale: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    size = readings[0].slope.shape[1]  # the outline knows of no depth noise: it has fewer
    normal, target = np.zeros((size, size)), np.zeros(size)
    # A rough outline is rough over longer runs: it counts for fewer independent readings.
    shares = shares[0], shares[1] / max(1.0, scatter[1]) ** 2
    for seen, by, share, trust in zip(readings, scatter, shares, (_tukey, _cauchy), strict=True):
        error = seen.sd_m * by * scale
        weight = share * trust(seen.found.gap_m / error) / error**2
        weighted = seen.slope * weight[:, None]
        own = slice(0, seen.slope.shape[1])
        normal[own, own] += weighted.T @ seen.slope
        target[own] -= weighted.T @ seen.found.gap_m
    return normal, target


def _moved(
    shape: TubeShape, beside: NDArray[np.float64], move: NDArray[np.float64]
) -> tuple[TubeShape, NDArray[np.float64]]:
    # A step beyond the body's own width would leave the readings that led it.
    limit = 0.6 * float(np.abs(shape.width_m).max()) + 0.002
    move = move * min(1.0, limit / max(float(np.abs(move[:BODY]).max()), 1e-12))
    split, last = shape.bend_m.size, BODY - SLIPS
    bend = shape.bend_m + move[:split].reshape(-1, 3)
    width = shape.width_m + move[split:last]
    # A body that vanishes on the way would lose its readings there for good.
    width = np.maximum(width, LEAST_WIDTH * float(np.median(width)))
    return TubeShape(bend, width), beside + move[last:]


@lru_cache(maxsize=4)
def _differences(count: int, order: int) -> NDArray[np.float64]:
    return np.diff(np.eye(count), order, axis=0)


def add_shape_prior(
    normal: NDArray[np.float64],
    target: NDArray[np.float64],
    shape: TubeShape,
    anchors_m: NDArray[np.float64],
    anchors_sd: NDArray[np.float64],
) -> None:
    bend, width = shape.bend_m, shape.width_m
    count, split = len(bend), bend.size
    steps = bend[1:] - bend[:-1]
    step = float(np.sqrt(np.einsum("ij,ij->i", steps, steps)).mean())
    radius = max(float(np.median(width)), 0.002)
    third = _differences(count, 3) / min(
        TWIST_SD * step / BEND_SEGMENTS**2, BEND_CHANGE_SD * step**3
    )
    bow = _differences(count, 2) / (BEND_SD * step**2)
    ends = bases(2)[0]
    hold = ends / (anchors_sd * radius)[:, None]
    same = third.T @ third + bow.T @ bow + hold.T @ hold  # for each coordinate alike
    # Control points keep their distances: nothing else tells where along the curve they sit.
    second = _differences(count, 2)
    tangent = bend[2:] - bend[:-2]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)[:, None]
    even = (second[:, :, None] * tangent[:, None, :]).reshape(count - 2, -1) / (SPEED_SD * step)
    # Where depth hardly tells, a fruit rather lies across the view than along it.
    middle = bend.mean(axis=0)
    deep = np.outer(ends[1] - ends[0], middle / np.linalg.norm(middle)).ravel()
    deep /= TILT_SD * step * BEND_SEGMENTS
    even = np.vstack([even, deep])
    normal[:split, :split] += even.T @ even
    for axis in range(3):
        normal[axis:split:3, axis:split:3] += same
    pull = same @ bend - hold.T @ (anchors_m / (anchors_sd * radius)[:, None])
    target[:split] -= pull.ravel() + even.T @ (even @ bend.ravel())
    rough = _differences(len(width), 2) / (WIDTH_SD * radius)
    rough = rough / np.sqrt(1 + (rough @ width / WIDTH_TAIL) ** 2)[:, None]
    widths = slice(split, split + len(width))
    normal[widths, widths] += rough.T @ rough
    target[widths] -= rough.T @ (rough @ width)


def add_beside_prior(
    normal: NDArray[np.float64],
    target: NDArray[np.float64],
    beside: NDArray[np.float64],
    evidence: Evidence,
) -> None:
    slips = 1 / (np.array(SLIP_SD_PX) * evidence.pixel_rad * evidence.far_m) ** 2
    weight = np.concatenate([slips, np.ones(evidence.waves)])
    last = np.arange(BODY - SLIPS, len(target))
    normal[last, last] += weight
    target[last] -= weight * beside


def _tukey(u: NDArray[np.float64]) -> NDArray[np.float64]:
    inside = np.maximum(1 - (u / TUKEY) ** 2, 0.0)
    return inside * inside


def _cauchy(u: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1 / (1 + (u / CAUCHY) ** 2)
