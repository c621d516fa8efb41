"""The tube: balls along a curve, its axis, lengths, diameters and inner arc."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


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


_TIP_BALLS = 4


def axis_path(centres_m: NDArray[Any], radii_m: NDArray[Any]) -> NDArray[np.float64]:
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
    centres_m: NDArray[np.float64], radii_m: NDArray[np.float64], overhangs_m: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def bending_direction(axis_m: NDArray[Any]) -> NDArray[np.float64]:
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


def thread_length(centres_m: NDArray[Any], radii_m: NDArray[Any], outward: NDArray[Any]) -> float:
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
    centres_m: NDArray[Any], radii_m: NDArray[Any], poles_m: NDArray[Any], outward: NDArray[Any]
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
    inner, _, _, _ = _contacts(centres_m, radii_m, -outward)
    return max(0.0, float(((inner - poles_m[0]) @ outward).max()))


def profile(
    centres_m: NDArray[Any], radii_m: NDArray[Any], samples: int = 101
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def _reaching(
    centres_m: NDArray[Any], radii_m: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # The balls between the two that reach farthest along the axis: beyond them all is swallowed.
    along, radii = arc_positions(centres_m), np.maximum(radii_m, 0.0)
    first, last = int(np.argmin(along - radii)), int(np.argmax(along + radii))
    if last <= first:
        first, last = 0, len(along) - 1
    centres = np.asarray(centres_m[first : last + 1], dtype=np.float64)
    return centres, np.asarray(radii[first : last + 1], dtype=np.float64)


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


def _unit(vector: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), dtype=np.float64)


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
    u = np.linspace(0.0, 1.0, samples)
    spline = CubicSpline(parameter, vertices, bc_type="natural")
    return float(np.trapezoid(np.linalg.norm(spline(u, 1), axis=1), u)), spline(u)


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

    points_m: NDArray[np.float64]
    centroid_m: NDArray[np.float64]
    axis: NDArray[np.float64]
    along_m: NDArray[np.float64]


def align_near(points_m: NDArray[Any], half_width_m: float) -> AlignedCloud:
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


def depth_gate(points_m: NDArray[Any], half_width_m: float) -> NDArray[Any]:
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
    inside: NDArray[np.bool_] = np.abs(z - np.median(z)) <= half_width_m
    return points_m[inside]


def principal_axis(points_m: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def bin_centroids(
    points_m: NDArray[Any], along_m: NDArray[Any], bins: int, at_least: int
) -> NDArray[np.float64]:
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
