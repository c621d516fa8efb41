"""Lay fruit on a bench or into a crate: each comes to rest on the ground or on what lies there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_lab.synthesis.occluders import Plane, Stem

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision_lab.synthesis.tube import Tube

__all__ = ["NEAREST_M", "Ground", "crate_rods", "lay"]

STEEPEST_DEG = 55.0
NEAREST_M = 0.24  # nothing is drawn nearer to the camera
EVERY = 8  # of a body's balls stand for it when it is laid
TRIES = 12


@dataclass(frozen=True, eq=False)
class Ground:
    """A level surface that the camera looks down on.

    Parameters
    ----------
    point_m : ndarray of float64, shape (3,)
        Where the optical axis meets it, camera coordinates, metres.
    frame : ndarray of float64, shape (3, 3)
        Rows: two unit vectors in the surface, and its normal, towards the camera.
    """

    point_m: NDArray[np.float64]
    frame: NDArray[np.float64]

    @classmethod
    def seen(cls, rng: np.random.Generator, distance_m: float) -> Ground:
        """Draw how a camera looks at it: from straight above to 55 degrees off, turned at will.

        Examples
        --------
        >>> ground = Ground.seen(np.random.default_rng(1), 0.6)
        >>> bool(np.allclose(ground.frame @ ground.frame.T, np.eye(3)))
        True
        """
        off = np.deg2rad(rng.uniform(0, STEEPEST_DEG))
        about = rng.normal(0, 0.15) if rng.random() < 0.7 else rng.uniform(0, 2 * np.pi)
        # The far side of a bench is up in the picture: the normal leans there (y points down).
        normal = np.array([0.0, -np.sin(off), -np.cos(off)])
        across = np.array([1.0, 0.0, 0.0])
        turn = np.array(
            [
                [np.cos(about), -np.sin(about), 0.0],
                [np.sin(about), np.cos(about), 0.0],
                [0.0, 0.0, 1.0],
            ]
        )
        frame = np.stack([across, np.cross(normal, across), normal]) @ turn.T
        return cls(np.array([0.0, 0.0, distance_m]), frame)

    @property
    def plane(self) -> Plane:
        """The surface itself."""
        return Plane(self.point_m, self.frame[2])

    def at(self, x_m: float, y_m: float, height_m: float) -> NDArray[np.float64]:
        """Give a point by its place on the surface and height above it, metres."""
        return np.asarray(self.point_m + np.array([x_m, y_m, height_m]) @ self.frame)

    def below(self, camera: Intrinsics, u: float, v: float) -> tuple[float, float]:
        """Give the place on the surface that a pixel sees, metres."""
        x, y = camera.rays(u, v)
        ray = np.array([float(x), float(y), 1.0])
        met = ray * float(self.frame[2] @ self.point_m) / float(self.frame[2] @ ray)
        place = self.frame @ (met - self.point_m)
        return float(place[0]), float(place[1])


def lay(
    rng: np.random.Generator,
    camera: Intrinsics,
    ground: Ground,
    bodies: Sequence[Tube],
    inner_m: tuple[float, float] | None = None,
) -> tuple[list[Tube], list[int]]:
    """Lay bodies down one after another.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance.
    camera : Intrinsics
        Who looks: on an open surface they lie where it sees them.
    ground : Ground
        What they lie on.
    bodies : sequence of Tube
        Plane bends about the origin, as `random_fruit` gives them.
    inner_m : tuple of float, optional
        Length and width of the crate that they lie in, its middle where the optical axis meets
        the ground; they lie along it, more or less.

    Returns
    -------
    placed : list of Tube
        In camera coordinates, none inside another.
    kept : list of int
        Which of `bodies` they are: one for which there was no room is left out.

    Notes
    -----
    A body keeps level and is let down until it touches the surface or another body. On an open
    surface the lowest of a few places is taken, so that they seldom lie on one another.
    """
    placed: list[Tube] = []
    kept: list[int] = []
    lain: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    for index, body in enumerate(bodies):
        best = None
        for _ in range(TRIES if inner_m is None else TRIES // 3):
            spot, turn = _spot(rng, camera, ground, body, inner_m)
            flat = body.centres_m[::EVERY] @ turn.T + np.array([*spot, 0.0])
            height = _rest(flat, body.radii_m[::EVERY], lain)
            if best is None or height < best[0]:
                best = height, flat, turn, spot
        if best is None:
            continue
        height, flat, turn, spot = best
        whole = body.moved(turn, (*spot, height))
        seen = whole.moved(ground.frame.T, ground.point_m)
        if seen.centres_m[:, 2].min() < NEAREST_M:
            continue
        lain.append((flat + np.array([0.0, 0.0, height]), body.radii_m[::EVERY]))
        placed.append(seen)
        kept.append(index)
    return placed, kept


def _spot(
    rng: np.random.Generator,
    camera: Intrinsics,
    ground: Ground,
    body: Tube,
    inner_m: tuple[float, float] | None,
) -> tuple[tuple[float, float], NDArray[np.float64]]:
    """Draw a place and a turn; rows of the turn are ground axes."""
    if inner_m is None:
        yaw = rng.uniform(0, 2 * np.pi)
        u, v = rng.uniform(0.08, 0.92) * camera.width, rng.uniform(0.1, 0.9) * camera.height
        spot = ground.below(camera, u, v)
    else:
        yaw = rng.normal(0, 0.12) + np.pi * rng.integers(2)
        room = np.array(inner_m) / 2 - np.array([body.chord_m / 2, float(body.radii_m.max())])
        x, y = rng.uniform(-1, 1, 2) * np.maximum(room, 0)
        spot = float(x), float(y)
    cos, sin = np.cos(yaw), np.sin(yaw)
    over = rng.choice([-1.0, 1.0])  # either flank may lie down
    turn = np.array([[cos, -sin * over, 0.0], [sin, cos * over, 0.0], [0.0, 0.0, over]])
    return spot, turn


def _rest(
    flat_m: NDArray[np.float64],
    radii_m: NDArray[np.float64],
    lain: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> float:
    """Give the height at which a level body, let down, touches something."""
    height = float((radii_m - flat_m[:, 2]).max())
    for centres, radii in lain:
        across = ((flat_m[:, None, :2] - centres[None, :, :2]) ** 2).sum(axis=2)
        reach = (radii_m[:, None] + radii[None]) ** 2 - across
        touch = centres[None, :, 2] + np.sqrt(np.maximum(reach, 0)) - flat_m[:, None, 2]
        if (reach > 0).any():
            height = max(height, float(touch[reach > 0].max()))
    return height


def crate_rods(
    rng: np.random.Generator, ground: Ground, inner_m: tuple[float, float]
) -> tuple[Stem, ...]:
    """Build a crate of bars around the middle of the ground.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance: height, thickness and number of bars.
    ground : Ground
        What it stands on.
    inner_m : tuple of float
        Length and width inside, metres.

    Returns
    -------
    tuple of Stem
        Level bars around, and posts at the corners; those that would reach behind the camera are
        left out.
    """
    radius = float(rng.uniform(0.004, 0.009))
    height = float(rng.uniform(0.07, 0.16))
    x, y = inner_m[0] / 2 + radius, inner_m[1] / 2 + radius
    corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
    bars = []
    for level in np.linspace(radius, height, int(rng.integers(3, 7))):
        ring = [ground.at(*corner, float(level)) for corner in corners]
        bars += [np.stack([ring[k], ring[(k + 1) % 4]]) for k in range(4)]
    bars += [np.stack([ground.at(*c, radius), ground.at(*c, height)]) for c in corners]
    return tuple(Stem(bar, radius) for bar in bars if bar[:, 2].min() > NEAREST_M / 2)
