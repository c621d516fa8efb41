"""Fit a tube to what was seen, with the priors of its shape and of the measurement errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from cucumbervision.arrays import Array, Ints, Mask, Numbers
from cucumbervision.tube import compiled as tube_kernel
from cucumbervision.tube.evidence import (
    BODY,
    SHAPE,
    SLIPS,
    Evidence,
    Gaps,
    ends_seen,
    normal_equations,
    point_readings,
    quick_median,
    ray_readings,
)
from cucumbervision.tube.shape import (
    BALLS,
    BEND_SEGMENTS,
    FINE,
    TubeShape,
    arc_positions,
    bases,
    principal_axis,
    robust_plane,
    shape_from_curve,
)

# In shares of the length L and the radius r.
_TWIST_SD = 1.0  # the curvature's change k' over the length: k' L^2
_BEND_SD, _BEND_CHANGE_SD = 8.0, 100.0  # curvature k, 1/m, and its change along the fruit, 1/m^2
_TILT_SD = 0.6  # difference of the ends along the view
_SPEED_SD = 0.02  # a control point's distance to the next, from one to the next
_WIDTH_SD = 0.05  # the radius' second difference; with heavy tails, which permit shoulders
_WIDTH_TAIL = 1.0
# Tolerance of an end's position about the initial guess, radii: for a visible end (where it must
# not matter), and for one that a leaf or the edge of the image hides.
_ANCHOR_SD, _HIDDEN_ANCHOR_SD = 1.5, 0.15
# Colour and depth are registered to about a pixel, and masks are too wide or too narrow. A larger
# tolerance for the latter is better on masks 3 px too wide, but real depth does not constrain the
# roundness of a body enough: the length of rigid bodies then varies between captures.
_SLIP_SD_PX = (1.0, 1.0, 0.1)


def add_shape_prior(
    normal: Array, target: Array, shape: TubeShape, anchors_m: Array, anchors_sd: Array
) -> None:
    """Add the prior of a fruit's shape to normal equations, in place.

    Curvature is small and changes slowly, control points are evenly spaced, the fruit is more
    likely to lie across the view than along it, and the radius changes smoothly.

    Parameters
    ----------
    normal : ndarray of float64, shape (K, K)
        1/m²; the first `SHAPE` unknowns are changed.
    target : ndarray of float64, shape (K,)
        1/m.
    shape : TubeShape
        The present body, camera coordinates.
    anchors_m : ndarray of float64, shape (2, 3)
        Initial positions of the ends.
    anchors_sd : ndarray of float64, shape (2,)
        Their tolerances, radii.
    """
    bend, width = shape.bend_m, shape.width_m
    count, split = len(bend), bend.size
    steps = bend[1:] - bend[:-1]
    step = float(np.sqrt(np.einsum("ij,ij->i", steps, steps)).mean())
    radius = max(quick_median(width), 0.002)
    second, smooth, twist = _differences(count)
    twist_sd = min(_TWIST_SD * step / BEND_SEGMENTS**2, _BEND_CHANGE_SD * step**3)
    ends = bases(2)[0]
    hold = ends / (anchors_sd * radius)[:, None]
    # For each coordinate alike.
    same = twist / twist_sd**2 + smooth / (_BEND_SD * step**2) ** 2 + hold.T @ hold
    # Control points are evenly spaced: nothing else determines their positions along the curve.
    tangent = bend[2:] - bend[:-2]
    tangent /= np.maximum(np.sqrt(np.einsum("ij,ij->i", tangent, tangent)), 1e-9)[:, None]
    even = np.empty((count - 1, split))
    by_axis = even.reshape(count - 1, count, 3)
    np.multiply(second[:, :, None], tangent[:, None, :] / (_SPEED_SD * step), out=by_axis[:-1])
    # Where depth constrains it little, a fruit is assumed to lie across the view.
    middle = bend.mean(axis=0)
    middle /= np.sqrt(middle @ middle) * _TILT_SD * step * BEND_SEGMENTS
    np.multiply((ends[1] - ends[0])[:, None], middle, out=by_axis[-1])
    normal[:split, :split] += even.T @ even
    for axis in range(3):
        normal[axis:split:3, axis:split:3] += same
    pull = same @ bend - hold.T @ (anchors_m / (anchors_sd * radius)[:, None])
    target[:split] -= pull.ravel() + even.T @ (even @ bend.ravel())
    rough = _differences(len(width))[0] / (_WIDTH_SD * radius)
    rough = rough / np.sqrt(1 + (rough @ width / _WIDTH_TAIL) ** 2)[:, None]
    widths = slice(split, split + len(width))
    normal[widths, widths] += rough.T @ rough
    target[widths] -= rough.T @ (rough @ width)


@lru_cache(maxsize=4)
def _differences(count: int) -> tuple[Array, Array, Array]:
    # The second differences' matrix; its square, and the third differences'.
    second, third = (np.diff(np.eye(count), order, axis=0) for order in (2, 3))
    return second, second.T @ second, third.T @ third


def add_nuisance_prior(normal: Array, target: Array, nuisance: Array, evidence: Evidence) -> None:
    """Add the priors of the outline's shift and of the depth waves to normal equations, in place.

    Parameters
    ----------
    normal : ndarray of float64, shape (BODY + W, BODY + W)
        1/m² for the slips, 1 for the waves.
    target : ndarray of float64, shape (BODY + W,)
        1/m, and 1.
    nuisance : ndarray of float64, shape (SLIPS + W,)
        The present slips, metres, and waves.
    evidence : Evidence
        What was seen: a pixel's size at its distance.
    """
    slips = 1 / (np.array(_SLIP_SD_PX) * evidence.pixel_rad * evidence.far_m) ** 2
    weight = np.concatenate([slips, np.ones(evidence.waves)])
    last = np.arange(BODY - SLIPS, len(target))
    normal[last, last] += weight
    target[last] -= weight * nuisance


# Factor on the error of each reading, by step.
_SCHEDULE = (16.0, 10.0, 6.0, 4.0, 2.5, 1.6, 1.0, 1.0, 1.0)
_MORE_STEPS = 6  # at most, until the step is smaller, or the length has not changed twice
_STILL_M, _STILL_SHARE = 1e-4, 3e-4
_SETTLED = 6  # first step that uses the scatter of outline and depth
END_SHARE = 0.1
"""Share of the axis over which an end's direction is taken."""

_LEAST_WIDTH = 0.15  # of the middle radius
_LEAST_HOLD = 1e-9  # of the mean weight, on every unknown, so that the equations have a solution
SCATTER_POINTS, SCATTER_RAYS = (0.7, 3.0), (0.5, 2.0)


@dataclass(frozen=True, eq=False)
class TubeFitting:
    """A fitted shape with its residuals.

    Parameters
    ----------
    shape : TubeShape
        The body.
    covariance : ndarray of float64, shape (39, 39)
        Of the shape's control points row by row, of its control radii, and of `slip_px` at the
        fruit's distance; square metres.
    points, rays : Gaps
        Residuals of the depth points and of the outline's rays.
    ends_seen : tuple of bool
        Whether the outline goes round the curve's first and last end.
    misfit : float
        Squared gaps in units of their own error, each counted up to `_MISFIT_SD`, as many as
        there are independent readings; for comparing fits of one fruit.
    """

    shape: TubeShape
    covariance: Array
    points: Gaps
    rays: Gaps
    ends_seen: tuple[bool, bool]
    misfit: float = 0.0

    @property
    def centreline_sd_m(self) -> float:
        """Standard deviation of the axis' length from pole to pole, metres."""
        bend, width = bases(BALLS)
        steps = np.diff(bend @ self.shape.bend_m, axis=0)
        steps /= np.maximum(np.linalg.norm(steps, axis=1), 1e-12)[:, None]
        by_bend = np.diff(bend, axis=0).T @ steps
        slope = np.concatenate([by_bend.ravel(), width[0] + width[-1], np.zeros(SLIPS)])
        return float(np.sqrt(max(slope @ self.covariance @ slope, 0.0)))

    @property
    def ends_covariance(self) -> Array:
        """Covariance of the first and the last end, shape (2, 6, 6).

        Of each pole's place (metres) and of the unit vector that leads out of the body there.
        """
        centres, radii = self.shape.balls()
        bend, width = bases(BALLS)
        within = round(END_SHARE * BALLS)
        covariances = []
        for end, inner in ((0, within), (-1, -1 - within)):
            run = centres[end] - centres[inner]
            out = run / max(float(np.linalg.norm(run)), 1e-9)
            across = (np.eye(3) - np.outer(out, out)) / max(float(np.linalg.norm(run)), 1e-9)
            by_bend = _kron(bend[end] - bend[inner], across)
            place = _kron(bend[end], np.eye(3)) + radii[end] * by_bend
            slope = np.zeros((6, len(self.covariance)))
            slope[:, : by_bend.shape[1]] = np.vstack([place, by_bend])
            slope[:3, by_bend.shape[1] : SHAPE] = np.outer(out, width[end])
            covariances.append(slope @ self.covariance @ slope.T)
        return np.stack(covariances)


def _kron(weights: Array, matrix: Array) -> Array:
    # As np.kron, in a tenth of its time.
    return (matrix[:, None] * weights[None, :, None]).reshape(len(matrix), -1)


def fit_shape(evidence: Evidence, guess: TubeShape) -> TubeFitting:
    """Fit the shape by robust Gauss-Newton steps, from coarse to fine.

    Depth points are weighted by Tukey's biweight, which ignores flying pixels, outline rays by
    Cauchy's weight, which keeps some weight for a stalk or a shoulder. In the last steps both
    kinds are rescaled by their scatter, so that a rough outline gives depth more weight.

    Parameters
    ----------
    evidence : Evidence
        What was seen.
    guess : TubeShape
        Initial shape; its ends should lie inside the fruit.

    Returns
    -------
    TubeFitting
        The shape with its covariance and residuals.

    Examples
    --------
    A straight body seen from the side: surface points of its front, and no outline.

    >>> from cucumbervision.tube.shape import shape_from_curve
    >>> x, a = (m.ravel() for m in np.meshgrid(np.linspace(0, 0.2, 60), np.linspace(0.3, 2.8, 9)))
    >>> cloud = np.stack([x, 0.02 * np.cos(a), 0.5 - 0.02 * np.sin(a)], axis=1)
    >>> curve = np.stack([np.linspace(0.02, 0.18, 9), np.zeros(9), np.full(9, 0.505)], axis=1)
    >>> evidence = Evidence(cloud, np.full(540, 1e-3), np.empty((0, 3)), 1e-3, 1e-3, 1.0, 1.0)
    >>> centres, radii = fit_shape(evidence, shape_from_curve(curve, 0.015)).shape.balls(5)
    >>> centres[2, 2].round(3).tolist(), radii[2].round(3).tolist()
    (0.5, 0.02)
    """
    fit = tube_kernel.fitted(evidence, guess)
    if fit is None:
        return _fit_by_numpy(evidence, guess)
    bend_m, width_m, points, rays, covariance, (first, last), misfit = fit
    visible, shape = (bool(first), bool(last)), TubeShape(bend_m, width_m)
    return TubeFitting(shape, covariance, _gaps_of(*points), _gaps_of(*rays), visible, misfit)


def _gaps_of(gap_m: Array, away: Array, centres_m: Array, *others: Numbers) -> Gaps:
    # Results of the kernel; the last array holds the position of each reading along the curve.
    index = others[-1]
    bend, width = (table.take(index, axis=0) for table in bases(FINE + 1))
    return Gaps(gap_m, away, bend, width, centres_m, index / FINE)


def _fit_by_numpy(evidence: Evidence, guess: TubeShape) -> TubeFitting:
    shape, nuisance = guess, np.zeros(SLIPS + evidence.waves)
    scatter, hold = (1.0, 1.0), np.full(2, _ANCHOR_SD)
    anchors = guess.balls(2)[0]
    settled, length_m, still = False, 0.0, 0
    for step, scale in enumerate((*_SCHEDULE, *[_SCHEDULE[-1]] * _MORE_STEPS)):
        if settled and step >= len(_SCHEDULE):
            break
        points = point_readings(evidence, shape, nuisance)
        rays = ray_readings(evidence, shape, nuisance[:SLIPS])
        if step >= _SETTLED:
            scatter = points.scatter(SCATTER_POINTS), rays.scatter(SCATTER_RAYS)
            visible = ends_seen(shape, rays.contacts, evidence.rays)
            hold = np.where(visible, _ANCHOR_SD, _HIDDEN_ANCHOR_SD)
        shares = evidence.points_share, evidence.rays_share
        normal, target = normal_equations((points, rays), shares, scatter, scale)
        add_shape_prior(normal, target, shape, anchors, hold)
        add_nuisance_prior(normal, target, nuisance, evidence)
        body = np.arange(BODY)
        normal[body, body] += _LEAST_HOLD * float(normal[body, body].mean())
        move = np.asarray(np.linalg.solve(normal, target))
        settled = float(np.abs(move[:SHAPE]).max()) < _STILL_M
        shape, move = stepped(shape, move)
        if step >= _SETTLED:
            before, length_m = length_m, shape.length_m
            still = still + 1 if abs(length_m - before) < _STILL_SHARE * length_m else 0
            settled = settled or still > 1
        nuisance = nuisance + move[SHAPE:]
    rays = ray_readings(evidence, shape, nuisance[:SLIPS])
    points = point_readings(evidence, shape, nuisance)
    misfit = sum(r.misfit(n) for r, n in zip((points, rays), shares, strict=True))
    waves = points.slope[:, BODY:] @ nuisance[SLIPS:]
    remains = replace(points.contacts, gap_m=points.contacts.gap_m - waves)
    covariance = np.asarray(np.linalg.solve(normal, np.eye(len(normal), BODY))[:BODY])
    visible = ends_seen(shape, rays.contacts, evidence.rays)
    return TubeFitting(shape, covariance, remains, rays.contacts, visible, misfit)


def stepped(shape: TubeShape, move: Array) -> tuple[TubeShape, Array]:
    """Return a body after a step, and the step as it was taken.

    A step longer than the body's width is shortened, because it would leave the readings that
    determined it. The radius stays above `_LEAST_WIDTH` of the median, because a body that
    vanishes somewhere would lose its readings there.

    Parameters
    ----------
    shape : TubeShape
        The body before.
    move : ndarray of float64, shape (K,)
        The step; its first `SHAPE` unknowns are the body's, metres.
    """
    limit = 0.6 * float(np.abs(shape.width_m).max()) + 0.002
    move = move * min(1.0, limit / max(float(np.abs(move[:BODY]).max()), 1e-12))
    split = shape.bend_m.size
    width = shape.width_m + move[split:SHAPE]
    width = np.maximum(width, _LEAST_WIDTH * quick_median(width))
    return TubeShape(shape.bend_m + move[:split].reshape(-1, 3), width), move


_ROUNDS = 4
_DEEP_M = 0.03  # distance of a bent and round fruit from its plane
_LEAST_MIDLINE = 9  # points of a mask, and readings, that a middle line needs
_PLANE_RIDGE, _LEAST_OFF_M = 1e-6, 0.002


def near_depths(points_m: Array) -> Mask:
    """Return which points are near the plane of most of them.

    A tilted fruit lies along a plane even if it is steep or its middle is hidden. Background in
    the mask does not, nor do readings that the sensor blends between the two.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Camera coordinates, metres.

    Returns
    -------
    ndarray of bool, shape (N,)
        Within three median deviations and `_DEEP_M` in depth.

    Examples
    --------
    >>> x = np.linspace(-0.1, 0.1, 9)
    >>> steep = np.stack([x, 0.1 * x, 0.6 + x], axis=1)
    >>> near_depths(np.vstack([steep, [[0.05, 0.0, 0.9]]])).tolist()[-2:]
    [True, False]
    """
    depth_m = points_m[:, 2]
    # A plane in space is linear in the inverse depth over the picture.
    terms = np.column_stack([points_m[:, :2] / depth_m[:, None], np.ones(len(depth_m))])
    off = robust_plane(terms, 1 / depth_m, depth_m**2, _LEAST_OFF_M, _PLANE_RIDGE)[1]
    inliers: Mask = off <= 3.0 * quick_median(off) + _DEEP_M
    return inliers


def guess_shape(points_m: Array, level: Mask | None = None) -> TubeShape:
    """Guess a tube: a parabola along the principal axis, moved inward by its own radius.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Points of the visible surface, camera coordinates, metres.
    level : ndarray of bool, shape (N,), optional
        Points that may belong to the fruit, from `near_depths`; by default all.

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
    if level is None:
        level = np.ones(len(points_m), dtype=bool)
    inliers = level
    for _ in range(_ROUNDS):
        centroid, axis = principal_axis(points_m[inliers])
        along = (points_m - centroid) @ axis
        off = points_m - centroid - along[:, None] * axis
        power = _powers(along)
        bow = np.linalg.lstsq(power[inliers], off[inliers], rcond=None)[0]
        residual = off - power @ bow
        distance = np.sqrt(np.einsum("ij,ij->i", residual, residual))
        inliers = level & (distance <= 3.0 * quick_median(distance[inliers]) + 1e-6)
    view = centroid / np.linalg.norm(centroid)
    side = np.cross(axis, view)
    norm = float(np.linalg.norm(side))
    across = np.abs(residual[inliers] @ side) / norm if norm > 0.05 else distance[inliers]
    radius = 2.0 * quick_median(across)
    t = _inner(np.quantile(along[inliers], [0.002, 0.998]), radius)
    return _tube_behind(centroid + t[:, None] * axis + _powers(t) @ bow, radius)


def _inner(ends: Array, radius: float) -> Array:
    """Return positions between two, without a radius at each end."""
    short = min(radius, 0.4 * float(np.ptp(ends)))
    return np.linspace(ends[0] + short, ends[1] - short, 33)


def _powers(t: Array) -> Array:
    return np.stack([np.ones_like(t), t, t**2], axis=1)


def _tube_behind(surface_m: Array, radius: float) -> TubeShape:
    """Return the tube whose visible surface has a middle line."""
    inward = surface_m / np.linalg.norm(surface_m, axis=1)[:, None]
    return shape_from_curve(surface_m + 0.785 * radius * inward, max(radius, 1e-3))


def guess_from_picture(
    picture: Array, has_depth: Mask, inverse_depth: Array, *, by_girth: bool = False
) -> TubeShape:
    """Guess a tube from its mask: a parabola in the picture, on a plane in depth.

    A fruit nearer than the sensor's range has too few readings for a plane. Its outline then gives
    the tilt, because a fruit of even thickness appears thicker where it is nearer.

    Parameters
    ----------
    picture : ndarray of float64, shape (N, 2)
        The mask's pixels as x / z and y / z.
    has_depth : ndarray of bool, shape (N,)
        Whether each of them has a depth reading.
    inverse_depth : ndarray of float64, shape (K,)
        One over the depth of these, 1/m.
    by_girth : bool
        Whether the outline determines the slope of the plane, instead of the readings.

    Returns
    -------
    TubeShape
        Its ends one radius short of the mask's.

    Examples
    --------
    >>> x, a = (m.ravel() for m in np.meshgrid(np.linspace(0, 0.4, 99), np.linspace(-1, 1, 30)))
    >>> mask = np.stack([x, 0.04 * a], axis=1)
    >>> guess = guess_from_picture(mask, np.abs(a) < 0.5, np.full((np.abs(a) < 0.5).sum(), 2.0))
    >>> centres, radii = guess.balls(3)
    >>> centres[:, 0].round(2).tolist(), radii[1].round(2).tolist()
    ([0.02, 0.1, 0.18], 0.02)
    """
    middle = picture.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((picture - middle).T))
    along, across = ((picture - middle) @ axes[:, k] for k in (1, 0))
    power = _powers(along)
    bow = np.linalg.lstsq(power, across, rcond=None)[0]
    half = 2.0 * float(np.median(np.abs(across - power @ bow)))
    terms = power[has_depth][:, :2]
    girth = np.linalg.lstsq(power[:, :2], np.abs(across - power @ bow), rcond=None)[0]
    if by_girth:
        plane = girth * np.median(inverse_depth / np.maximum(terms @ girth, 0.05 * half))
    else:
        columns, scale = terms[:, ::-1], 1 / float(np.median(inverse_depth)) ** 2
        plane = robust_plane(columns, inverse_depth, scale, _LEAST_OFF_M)[0][::-1]
    t = _inner(np.quantile(along, [0.005, 0.995]), half)
    powers = _powers(t)
    line = middle + t[:, None] * axes[:, 1] + (powers @ bow)[:, None] * axes[:, 0]
    usual = float(np.median(inverse_depth))
    depth_m = 1 / np.clip(powers[:, :2] @ plane, 0.5 * usual, 2.0 * usual)
    surface_m = np.column_stack([line, np.ones(len(line))]) * depth_m[:, None]
    return _tube_behind(surface_m, max(half / usual, 1e-3))


def guess_from_midline(picture: Array, mask: Mask, depth_m: Array) -> TubeShape | None:
    """Guess a tube along the middle line of its mask, also for a strongly bent fruit.

    The line is the cheapest path between the two points of the mask that are farthest apart
    within it, where a step costs the more the nearer it is to the outline (Dijkstra 1959).

    Parameters
    ----------
    picture : ndarray of float64, shape (G, 2)
        A grid over the mask's window as x / z and y / z.
    mask : ndarray of bool, shape (G,)
        Whether each of its points belongs to the mask.
    depth_m : ndarray of float64, shape (G,)
        Depth at each of them, metres; 0 without a reading.

    Returns
    -------
    TubeShape or None
        Its ends one radius short of the mask's; None without outline, depth, or a path.

    Examples
    --------
    A half ring of 8 cm radius, 3 cm wide, at 0.5 m:

    >>> sides = np.linspace(-0.25, 0.25, 81), np.linspace(0, 0.25, 41)
    >>> x, y = (m.ravel() for m in np.meshgrid(*sides))
    >>> ring = np.abs(np.hypot(x, y) - 0.16) < 0.03
    >>> guess = guess_from_midline(np.stack([x, y], axis=1), ring, np.full(len(x), 0.5))
    >>> centres, radii = guess.balls(9)
    >>> bool(np.abs(np.hypot(*centres[2:-2, :2].T) - 0.082).max() < 0.005), float(radii[4].round(2))
    (True, 0.02)
    """
    from scipy.spatial import cKDTree

    points, readable = picture[mask], mask & (depth_m > 0)
    if len(points) < _LEAST_MIDLINE or readable.sum() < _LEAST_MIDLINE or mask.all():
        return None
    tree = cKDTree(points)
    step = float(np.median(_nearest(tree, points, 2)[0][:, 1]))
    inside = _nearest(cKDTree(picture[~mask]), points, 1)[0][:, 0]
    pairs = tree.query_pairs(1.6 * step, output_type="ndarray")
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    within = _graph(pairs, lengths, len(points))
    first = _farthest(_paths(within, int(np.argmax(inside)))[0])
    last = _farthest(_paths(within, first)[0])
    cost = lengths / (inside[pairs].mean(axis=1) / inside.max()) ** 2
    before = _paths(_graph(pairs, cost, len(points)), first)[1]
    line = [last]
    while line[-1] != first and len(line) < len(points):
        line.append(int(before[line[-1]]))
    half = float(np.median(inside[line]))
    along = arc_positions(points[line])
    positions = _inner(along[[0, -1]], half)
    path = np.stack([np.interp(positions, along, points[line][:, k]) for k in (0, 1)], axis=1)
    neighbours = _nearest(cKDTree(picture[readable]), path, _LEAST_MIDLINE)[1]
    line_depth_m = np.median(depth_m[readable][neighbours], axis=1)
    surface_m = np.column_stack([path, np.ones(len(path))]) * line_depth_m[:, None]
    return _tube_behind(surface_m, max(half * float(np.median(line_depth_m)), 1e-3))


def _nearest(tree: Any, points: Array, count: int) -> tuple[Array, Ints]:
    # Distances and numbers of the nearest points, (N, count) each.
    distance, number = tree.query(points, k=range(1, count + 1))
    return np.asarray(distance), np.asarray(number)


def _graph(pairs: Ints, cost: Array, count: int) -> Any:
    # Graph of the points with the cost of each pair.
    from scipy.sparse import coo_array

    ends = pairs.T.astype(np.int32)  # SciPy 1.13 takes no other indices
    return coo_array((cost, (ends[0], ends[1])), shape=(count, count)).tocsr()


def _paths(graph: Any, start: int) -> tuple[Array, Ints]:
    # Cost of the path from a point to every other one, and the last point before that.
    from scipy.sparse import csgraph

    result: Any = csgraph.dijkstra(graph, False, start, True)  # type: ignore[call-overload]
    return np.asarray(result[0]), np.asarray(result[1])


def _farthest(distance: Array) -> int:
    return int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))
