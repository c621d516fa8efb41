"""A fruit as a swept ball: a body whose lengths are known exactly.

The body is the union of balls whose centres run along a curve. Its ends are round, and each end's
pole lies one radius beyond the last centre, along the curve's tangent there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.geometry.curve import polyline_length

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["Tube", "arc_tube", "helix_tube", "rotation"]

BALLS = 800  # at 25 cm a ball every 0.3 mm: the surface ripples by less than a micrometre
CAP_POINTS = 400


@dataclass(frozen=True, eq=False)
class Tube:
    """A swept ball in camera coordinates.

    Parameters
    ----------
    centres_m : ndarray of float64, shape (K, 3)
        Centres of the balls in order from blossom end to stem end, metres.
    radii_m : ndarray of float64, shape (K,)
        Their radii in metres.
    outward : ndarray of float64, shape (3,)
        Unit vector in the plane of bending, towards the convex side at the middle.
    """

    centres_m: NDArray[np.float64]
    radii_m: NDArray[np.float64]
    outward: NDArray[np.float64]

    @property
    def poles_m(self) -> NDArray[np.float64]:
        """The two ends of the axis, shape (2, 3), metres."""
        first, last = self._end_tangents()
        return np.stack(
            [
                self.centres_m[0] - self.radii_m[0] * first,
                self.centres_m[-1] + self.radii_m[-1] * last,
            ]
        )

    @property
    def axis_m(self) -> NDArray[np.float64]:
        """The central axis from pole to pole, shape (K + 2, 3), metres."""
        blossom, stem = self.poles_m
        return np.vstack([blossom, self.centres_m, stem])

    @property
    def centreline_m(self) -> float:
        """Arc length of the central axis from pole to pole, metres."""
        return polyline_length(self.axis_m)

    @property
    def chord_m(self) -> float:
        """Straight distance between the poles, metres."""
        return float(np.linalg.norm(self.poles_m[1] - self.poles_m[0]))

    @property
    def thread_m(self) -> float:
        """Length of a taut thread laid from pole to pole over the `outward` side, metres.

        It is the shortest line in the plane of bending that leaves each pole over the round end
        on that side and never enters the body: on the body where its outline is convex, straight
        where it is hollow (the far half of an S, the root of a neck). Meant for plane bends.
        """
        return polyline_length(self.thread_path_m)

    @property
    def thread_path_m(self) -> NDArray[np.float64]:
        """The taut thread of `thread_m` as a polyline, shape (N, 3), metres."""
        tangents = np.gradient(self.centres_m, axis=0)
        speed = np.linalg.norm(tangents, axis=1)
        tangents /= speed[:, None]
        # The side that stays outward all along a plane bend: perpendicular to the tangent.
        across = self.outward - (tangents @ self.outward)[:, None] * tangents
        across /= np.linalg.norm(across, axis=1)[:, None]
        slope = np.clip(np.gradient(self.radii_m) / speed, -1.0, 1.0)
        # Angle of the contact with the common envelope, from the tangent towards outward; at the
        # ends the thread turns from there to the pole (pi at the blossom end, 0 at the stem end).
        angle = np.arccos(-slope)
        first, last = (np.full(CAP_POINTS, k) for k in (0, len(self.radii_m) - 1))
        k = np.concatenate([first, np.arange(len(self.radii_m)), last])
        angles = np.concatenate(
            [
                np.linspace(np.pi, angle[0], CAP_POINTS, endpoint=False),
                angle,
                np.linspace(0.0, angle[-1], CAP_POINTS, endpoint=False)[::-1],
            ]
        )[:, None]
        around = np.cos(angles) * tangents[k] + np.sin(angles) * across[k]
        line = self.centres_m[k] + self.radii_m[k, None] * around
        chord = self.poles_m[1] - self.poles_m[0]
        kept = _taut(np.stack([line @ chord, line @ self.outward], axis=1))
        return np.asarray(line[kept])

    def moved(self, turn: NDArray[np.float64], by_m: ArrayLike) -> Tube:
        """Give the same body turned about the origin by a 3x3 rotation, then moved by metres."""
        return Tube(
            self.centres_m @ turn.T + np.asarray(by_m, dtype=float),
            self.radii_m,
            self.outward @ turn.T,
        )

    def _end_tangents(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        first = self.centres_m[1] - self.centres_m[0]
        last = self.centres_m[-1] - self.centres_m[-2]
        return first / np.linalg.norm(first), last / np.linalg.norm(last)


def _taut(line: NDArray[np.float64]) -> NDArray[np.intp]:
    # What stays of a line that has the body on its right when it is pulled tight: every point at
    # which the line would turn left is let go. No two points in a row may coincide.
    kept: list[int] = []
    points = line.tolist()
    for k, (x, y) in enumerate(points):
        while len(kept) > 1:
            (x0, y0), (x1, y1) = points[kept[-2]], points[kept[-1]]
            if (x1 - x0) * (y - y1) <= (y1 - y0) * (x - x1):
                break
            kept.pop()
        kept.append(k)
    return np.array(kept)


def arc_tube(
    length_m: float,
    radius_m: float,
    bend_radius_m: float = np.inf,
    *,
    neck: float = 0.0,
    balls: int = BALLS,
) -> Tube:
    """Make a tube bent to a circular arc, centred on the origin, its chord along x.

    Parameters
    ----------
    length_m : float
        Centreline from pole to pole, metres; more than the two end radii.
    radius_m : float
        Radius of the body, metres.
    bend_radius_m : float
        Radius of the axis' arc, metres; infinite for a straight fruit. Its convex side faces -y
        (up in the picture).
    neck : float
        Share by which the stem end is thinner than the body, 0 to below 1.
    balls : int
        Number of balls.

    Returns
    -------
    Tube
        With `centreline_m` equal to `length_m`.

    Raises
    ------
    ValueError
        If the body would be shorter than its round ends.

    Examples
    --------
    By hand, for an arc of radius R over an angle p, the thread is (R + r) p + pi r:

    >>> tube = arc_tube(0.25, 0.02, 0.30)
    >>> angle = (0.25 - 2 * 0.02) / 0.30
    >>> round(tube.thread_m, 4), round((0.30 + 0.02) * angle + np.pi * 0.02, 4)
    (0.2868, 0.2868)
    >>> round(tube.centreline_m, 6)
    0.25
    """
    share = np.linspace(0.0, 1.0, balls)
    taper = np.clip((share - 0.6) / 0.4, 0.0, 1.0)
    radii = radius_m * (1 - neck * taper**2 * (3 - 2 * taper))
    run = length_m - radii[0] - radii[-1]
    if run <= 0:
        raise ValueError(f"a fruit of {length_m} m is shorter than its round ends")
    along = (share - 0.5) * run
    if np.isinf(bend_radius_m):
        x, y = along, np.zeros_like(along)
    else:
        angle = along / bend_radius_m
        x, y = bend_radius_m * np.sin(angle), bend_radius_m * (1 - np.cos(angle))
    return Tube(np.stack([x, y, np.zeros_like(x)], axis=1), radii, np.array([0.0, -1.0, 0.0]))


def helix_tube(
    radius_m: float, helix_radius_m: float, pitch_m: float, turns: float, balls: int = 2000
) -> Tube:
    """Make a tube wound on a helix about x: a curve whose length is known by hand.

    The centres' arc length is turns * sqrt((2 pi helix_radius)^2 + pitch^2).

    Examples
    --------
    >>> tube = helix_tube(0.01, 0.03, 0.2, 1.0)
    >>> by_hand = np.hypot(2 * np.pi * 0.03, 0.2) + 2 * 0.01
    >>> bool(abs(tube.centreline_m - by_hand) < 1e-6)
    True
    """
    angle = np.linspace(-np.pi * turns, np.pi * turns, balls)
    centres = np.stack(
        [
            pitch_m * angle / (2 * np.pi),
            helix_radius_m * np.cos(angle),
            helix_radius_m * np.sin(angle),
        ],
        axis=1,
    )
    return Tube(centres, np.full(balls, radius_m), np.array([0.0, 1.0, 0.0]))


def rotation(roll_deg: float = 0.0, tilt_deg: float = 0.0, spin_deg: float = 0.0) -> NDArray[Any]:
    """Give a 3x3 rotation: spin about the fruit's axis x, tilt to the camera, roll in the picture.

    Parameters
    ----------
    roll_deg : float
        Angle of the axis in the picture, from x towards y (down), degrees.
    tilt_deg : float
        Angle of the axis out of the picture plane, towards +z, degrees.
    spin_deg : float
        Turn about the fruit's own axis, degrees.

    Examples
    --------
    >>> (rotation(roll_deg=90) @ [1, 0, 0]).round(6).tolist()
    [0.0, 1.0, 0.0]
    >>> (rotation(tilt_deg=90) @ [1, 0, 0]).round(6).tolist()
    [0.0, 0.0, 1.0]
    """
    from scipy.spatial.transform import Rotation

    angles = [roll_deg, -tilt_deg, spin_deg]
    turn: NDArray[Any] = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    return turn
