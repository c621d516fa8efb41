"""The tube: balls along a curve, its axis, lengths, diameters and inner arc."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.tube.curve import arc_positions

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
