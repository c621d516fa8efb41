"""The tube: balls along a curve, its axis, lengths, diameters and inner arc."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.arrays import Array, Mask, Numbers

BEND_SEGMENTS = 4
WIDTH_SEGMENTS = 12
BALLS = 64
FINE = 1024  # positions along the curve to which a nearest ball is rounded


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

    bend_m: Array
    width_m: Array

    @property
    def length_m(self) -> float:
        """Length of the curve and the radii at its ends, metres: about the axis from end to end."""
        centres, radii = self.balls()
        steps = centres[1:] - centres[:-1]
        return float(np.sqrt(np.einsum("ij,ij->i", steps, steps)).sum() + radii[0] + radii[-1])

    def balls(self, count: int = BALLS) -> tuple[Array, Array]:
        """Return centres, shape (count, 3), and radii, shape (count,), evenly along the curve."""
        bend, width = bases(count)
        return bend @ self.bend_m, width @ self.width_m


@lru_cache(maxsize=16)
def bases(count: int) -> tuple[Array, Array]:
    """Return each control point's weight in centre and radius at evenly spaced places.

    Parameters
    ----------
    count : int
        Number of places along the curve, from its first end to its last.

    Returns
    -------
    bend, width : ndarray of float64, shape (count, 7) and (count, 15)
        Uniform cubic B-splines (de Boor 1978), knots at multiples of one segment on both sides;
        rows sum to 1.

    Examples
    --------
    >>> bases(2)[0].round(3).tolist()[0]
    [0.167, 0.667, 0.167, 0.0, 0.0, 0.0, 0.0]
    """
    from scipy.interpolate import BSpline

    places = np.linspace(0.0, 1.0, count)
    bend, width = (
        BSpline.design_matrix(places, np.arange(-3, segments + 4) / segments, 3).toarray()
        for segments in (BEND_SEGMENTS, WIDTH_SEGMENTS)
    )
    return bend, width


def shape_from_curve(curve_m: Array, radius_m: float) -> TubeShape:
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


_TIP_BALLS = 4
_PLANE_ROUNDS = 6


def axis_path(centres_m: Numbers, radii_m: Numbers) -> Array:
    """Return the central axis from pole to pole.

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
    centres, radii = _reaching(centres_m, radii_m)
    start = _unit(centres[1] - centres[0])
    end = _unit(centres[-1] - centres[-2])
    return np.vstack([centres[0] - radii[0] * start, centres, centres[-1] + radii[-1] * end])


def with_tips(
    centres_m: Array, radii_m: Array, overhangs_m: tuple[float, float]
) -> tuple[Array, Array]:
    """Return a body with pointed ends, whose poles lie beyond those of its last balls.

    Parameters
    ----------
    centres_m : ndarray of float64, shape (K, 3)
        Centres in order.
    radii_m : ndarray of float64, shape (K,)
        Their radii.
    overhangs_m : tuple of float
        How far beyond the first and the last pole.

    Examples
    --------
    >>> x = np.linspace(0, 0.2, 9)
    >>> centres, radii = with_tips(np.stack([x, 0 * x, 0 * x], 1), np.full(9, 0.02), (0.0, 0.01))
    >>> axis_path(centres, radii)[[0, -1], 0].round(3).tolist()
    [-0.02, 0.23]
    """
    shares = np.linspace(0, 1, _TIP_BALLS + 1)[1:]
    for end, inner, overhang in ((0, 1, overhangs_m[0]), (-1, -2, overhangs_m[1])):
        if overhang <= 0:
            continue
        ahead = _unit(centres_m[end] - centres_m[inner])
        tip = centres_m[end] + shares[:, None] * (radii_m[end] + overhang) * ahead
        cone = radii_m[end] * (1 - shares)
        if end:
            centres_m, radii_m = np.vstack([centres_m, tip]), np.append(radii_m, cone)
        else:
            centres_m, radii_m = np.vstack([tip[::-1], centres_m]), np.append(cone[::-1], radii_m)
    return centres_m, radii_m


def bending_direction(axis_m: Numbers) -> Array:
    """Return the unit vector from the chord towards the convex side, in the plane of bending.

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


def thread_length(centres_m: Numbers, radii_m: Numbers, outward: Numbers) -> float:
    """Compute the length of the outer side of the bend between the two poles.

    It is the centreline's length plus |∫ κ r ds|, where κ is the signed curvature in the plane
    of bending and r the radius. For a straight body it is the centreline's length.

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
        Metres.

    Examples
    --------
    An arc of radius 0.3 over half a radian, 0.02 thick: (0.3 + 0.02) / 2, and a radius at each
    end.

    >>> t = np.linspace(0, 0.5, 801)
    >>> centres = 0.3 * np.stack([np.sin(t), np.cos(t), 0 * t], axis=1)
    >>> out = np.array([np.sin(0.25), np.cos(0.25), 0.0])
    >>> round(thread_length(centres, np.full(801, 0.02), out), 4)
    0.2
    """
    axis = axis_path(centres_m, radii_m)
    _, radii = _reaching(centres_m, radii_m)
    chord = _unit(axis[-1] - axis[0])
    across = _unit(outward - (outward @ chord) * chord)
    steps = np.diff(axis, axis=0)
    heading = np.unwrap(np.arctan2(steps @ across, steps @ chord))
    # The axis turns at its inner points, each the centre of one ball.
    return float(arc_positions(axis)[-1] + abs(np.diff(heading) @ radii))


def inner_arc_height(
    centres_m: Numbers, radii_m: Numbers, poles_m: Numbers, outward: Numbers
) -> float:
    """Return the largest distance from the chord to the body's inner edge.

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
    inner = _contacts(centres_m, radii_m, -outward)
    return max(0.0, float(((inner - poles_m[0]) @ outward).max()))


def profile(centres_m: Numbers, radii_m: Numbers, samples: int = 101) -> tuple[Array, Array]:
    """Return the body's diameter along its axis from pole to pole.

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
    >>> along, widths = profile(np.stack([x, 0 * x, 0 * x], axis=1), np.full(201, 0.02), 5)
    >>> along.round(3).tolist(), widths.round(3).tolist()
    ([0.0, 0.06, 0.12, 0.18, 0.24], [0.0, 0.04, 0.04, 0.04, 0.0])
    """
    position = arc_positions(centres_m)
    radii = np.maximum(radii_m, 0.0)
    start, stop = float((position - radii).min()), float((position + radii).max())
    along = np.linspace(start, stop, samples)
    half = radii**2 - (along[:, None] - position) ** 2
    return along - start, 2 * np.sqrt(np.maximum(half.max(axis=1), 0.0))


def _reaching(centres_m: Numbers, radii_m: Numbers) -> tuple[Array, Array]:
    # The balls between the two that reach farthest along the axis: beyond them all is swallowed.
    along, radii = arc_positions(centres_m), np.maximum(radii_m, 0.0)
    first, last = int(np.argmin(along - radii)), int(np.argmax(along + radii))
    if last <= first:
        first, last = 0, len(along) - 1
    centres = np.asarray(centres_m[first : last + 1], dtype=np.float64)
    return centres, np.asarray(radii[first : last + 1], dtype=np.float64)


def _contacts(centres_m: Numbers, radii_m: Numbers, side: Numbers) -> Array:
    # Where each ball touches the common envelope on one side.
    tangents = np.gradient(np.asarray(centres_m, dtype=np.float64), axis=0)
    speed = np.maximum(np.linalg.norm(tangents, axis=1), 1e-12)
    tangents /= speed[:, None]
    across = side - (tangents @ side)[:, None] * tangents
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None]
    slope = np.gradient(np.asarray(radii_m, dtype=np.float64)) / speed
    lean = np.clip(slope, -1.0, 1.0)[:, None]
    touch = -lean * tangents + np.sqrt(1 - lean**2) * across
    return np.asarray(centres_m + radii_m[:, None] * touch, dtype=np.float64)


def _unit(vector: Numbers) -> Array:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), dtype=np.float64)


_COINCIDENT = 1e-9  # of the whole: closer vertices are one, or their parameters would be


def polyline_length(vertices_m: Numbers) -> float:
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


def natural_spline(vertices_m: Numbers, samples: int = 1000) -> tuple[float, Array]:
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
    u = np.linspace(0.0, 1.0, samples)
    spline = CubicSpline(parameter, vertices, bc_type="natural")
    return float(np.trapezoid(np.linalg.norm(spline(u, 1), axis=1), u)), spline(u)


def arc_positions(centres_m: Numbers) -> Array:
    """Return each centre's arc length from the first, metres.

    Examples
    --------
    >>> arc_positions(np.array([[0.0, 0, 0], [3.0, 4.0, 0], [3.0, 4.0, 2.0]])).tolist()
    [0.0, 5.0, 7.0]
    """
    steps = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def points_along(vertices: Numbers, shares: ArrayLike) -> Array:
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


@dataclass(frozen=True, eq=False)
class AlignedCloud:
    """A cloud with its principal axis.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Camera coordinates in metres.
    centroid_m, axis : ndarray of float64, shape (3,)
        From `principal_axis`; not a number below two points.
    along_m : ndarray of float64, shape (N,)
        Each point's position along the axis, metres from the centroid.
    """

    points_m: Array
    centroid_m: Array
    axis: Array
    along_m: Array


def align_near(points_m: Numbers, half_width_m: float) -> AlignedCloud:
    """Gate a cloud by depth and find its principal axis: what M2, M3 and M5 begin with.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        Camera coordinates in metres.
    half_width_m : float
        As `depth_gate` takes it.

    Examples
    --------
    >>> cloud = align_near(np.array([[0.0, 0, 0.5], [0.2, 0, 0.5], [0.4, 0, 0.9]]), 0.035)
    >>> cloud.along_m.tolist()
    [-0.1, 0.1]
    """
    gated = depth_gate(points_m, half_width_m)
    if len(gated) < 2:
        nowhere = np.full(3, np.nan)
        return AlignedCloud(gated, nowhere, nowhere, np.full(len(gated), np.nan))
    centroid, axis = principal_axis(gated)
    along = np.asarray(gated @ axis - centroid @ axis, dtype=np.float64)
    return AlignedCloud(gated, centroid, axis, along)


def depth_gate(points_m: Numbers, half_width_m: float) -> Numbers:
    """Keep the points whose depth is within `half_width_m` of the median depth.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        Camera coordinates in metres, z forward.
    half_width_m : float
        Half the gate's width in metres.

    Returns
    -------
    ndarray of float, shape (M, 3)
        The points kept, in their order; empty for an empty cloud.

    Examples
    --------
    >>> points = np.array([[0.0, 0.0, 0.50], [0.0, 0.0, 0.51], [0.0, 0.0, 0.90]])
    >>> depth_gate(points, 0.035)[:, 2].tolist()
    [0.5, 0.51]
    """
    if not len(points_m):
        return points_m
    z = points_m[:, 2]
    inside: Mask = np.abs(z - np.median(z)) <= half_width_m
    return points_m[inside]


def principal_axis(points_m: Numbers) -> tuple[Array, Array]:
    """Return the centroid and the direction of largest spread.

    The first right singular vector of the centred cloud (the paper's Eq. 2), found as the first
    eigenvector of its scatter matrix: the same vector, without an SVD of N rows.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        At least two points; pixels (N, 2) give those of a mask, in pixels.

    Returns
    -------
    centroid_m, axis : ndarray of float64, shape (3,), or (2,) of pixels
        `axis` has length 1; its largest component is positive.

    Raises
    ------
    ValueError
        For fewer than two points.

    Examples
    --------
    >>> centroid, axis = principal_axis(np.array([[0.0, 0, 1], [2.0, 0, 1], [4.0, 0, 1]]))
    >>> centroid.tolist(), axis.round(6).tolist()
    ([2.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    """
    if len(points_m) < 2:
        raise ValueError(f"{len(points_m)} points have no axis")
    centroid = points_m.mean(axis=0, dtype=np.float64)
    centred = points_m - centroid
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return centroid, axis if axis[np.argmax(np.abs(axis))] > 0 else -axis


def robust_plane(
    terms: Array, values: Array, scale: Array | float, least: float, ridge: float = 0.0
) -> tuple[Array, Array]:
    """Fit a plane with about the least sum of absolute deviations.

    Parameters
    ----------
    terms : ndarray of float64, shape (N, K)
        Coordinates in the plane, and ones in the last column.
    values : ndarray of float64, shape (N,)
        What the plane gives: of a plane in space, the inverse depth over the image is linear.
    scale : ndarray of float64, shape (N,), or float
        Factor on the deviations.
    least : float
        Deviation below which all are equally good.
    ridge : float
        Share of the weights that holds the slopes near 0.

    Returns
    -------
    plane : ndarray of float64, shape (K,)
        Coefficients of the terms.
    off : ndarray of float64, shape (N,)
        The scaled absolute deviations.

    Examples
    --------
    >>> x = np.arange(9.0)
    >>> plane, off = robust_plane(np.stack([x, x**0], axis=1), 2 * x + 50 * (x == 4), 1.0, 1e-6)
    >>> (plane.round(3) + 0).tolist(), off.round(3).max()
    ([2.0, 0.0], np.float64(50.0))
    """
    weight = np.ones(len(values))
    held = ridge * np.diag([*np.ones(terms.shape[1] - 1), 0.0])
    for _ in range(_PLANE_ROUNDS):
        weighted = terms * weight[:, None]
        normal = weighted.T @ terms + held * weight.sum()
        plane = np.linalg.lstsq(normal, weighted.T @ values, rcond=None)[0]
        off = np.abs(values - terms @ plane) * scale
        weight = 1 / np.maximum(off, least)
    return plane, off


def bin_centroids(points_m: Numbers, along_m: Numbers, bins: int, at_least: int) -> Array:
    """Cut a cloud into equal bins along an axis and give the centroids of the filled ones.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        The cloud.
    along_m : ndarray of float, shape (N,)
        Each point's position along the axis, as `project` gives it.
    bins : int
        Number of bins from the smallest to the largest position.
    at_least : int
        Bins with fewer points are skipped.

    Returns
    -------
    ndarray of float64, shape (B, 3)
        B <= `bins` centroids, in order along the axis.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0], [10.0, 2.0, 0]])
    >>> bin_centroids(points, points[:, 0], bins=2, at_least=2).tolist()
    [[0.5, 0.0, 0.0], [9.5, 1.0, 0.0]]
    """
    start, stop = float(along_m.min()), float(along_m.max())
    if stop <= start:
        return np.empty((0, 3))
    index = np.minimum(((along_m - start) * (bins / (stop - start))).astype(np.intp), bins - 1)
    count = np.bincount(index, minlength=bins)
    sums = [np.bincount(index, points_m[:, k], minlength=bins) for k in range(3)]
    filled = count >= at_least
    return np.stack([s[filled] / count[filled] for s in sums], axis=1)
