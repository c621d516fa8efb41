"""Fruit as swept spheres with exactly known lengths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cucumbervision.tube.shape import polyline_length, thread_length
from cucumbervision_lab.arrays import Array, Generator

_BALLS = 800  # every 0.3 mm for a 25 cm fruit, so that the surface ripple is below 1 µm


@dataclass(frozen=True, eq=False)
class Tube:
    """A swept sphere in camera coordinates.

    Parameters
    ----------
    centres_m : ndarray of float64, shape (K, 3)
        Centres of the spheres from blossom end to stem end, metres.
    radii_m : ndarray of float64, shape (K,)
        Radii of the spheres, metres.
    outward : ndarray of float64, shape (3,)
        Unit vector in the plane of bending, towards the convex side at the middle.
    is_decoy : bool
        Whether it is another thing of the shape of a cucumber, such as a carrot or a pipe.
    """

    centres_m: Array
    radii_m: Array
    outward: Array
    is_decoy: bool = False

    @property
    def poles_m(self) -> Array:
        """The two ends of the axis, shape (2, 3), metres."""
        inner, outer = self.centres_m[[1, -2]], self.centres_m[[0, -1]]
        out = (outer - inner) / np.linalg.norm(outer - inner, axis=1)[:, None]
        return np.asarray(outer + self.radii_m[[0, -1], None] * out)

    @property
    def axis_m(self) -> Array:
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
        """Length along the outer side of the bend between the poles, metres."""
        return thread_length(self.centres_m, self.radii_m, self.outward)

    def moved(self, turn: Array, by_m: ArrayLike) -> Tube:
        """Return the body rotated about the origin by a 3x3 matrix, then translated by metres."""
        centres = self.centres_m @ turn.T + np.asarray(by_m, dtype=float)
        return replace(self, centres_m=centres, outward=self.outward @ turn.T)


def arc_tube(
    length_m: float, radius_m: float, bend_radius_m: float = np.inf, *, neck: float = 0.0
) -> Tube:
    """Create a tube bent to a circular arc, centred at the origin with its chord along x.

    Parameters
    ----------
    length_m : float
        Length of the centreline from pole to pole, metres; greater than the sum of the end radii.
    radius_m : float
        Radius of the body, metres.
    bend_radius_m : float
        Radius of the axis, metres; infinite for a straight fruit. The convex side faces -y (up in
        the picture).
    neck : float
        Relative reduction of the radius at the stem end, 0 to below 1.

    Returns
    -------
    Tube
        Tube with `centreline_m` equal to `length_m`.

    Raises
    ------
    ValueError
        If `length_m` is less than the sum of the end radii.

    Examples
    --------
    For an arc of radius R and angle p, the outer side has the length (R + r) p + 2 r:

    >>> tube = arc_tube(0.25, 0.02, 0.30)
    >>> angle = (0.25 - 2 * 0.02) / 0.30
    >>> round(tube.thread_m, 4), round((0.30 + 0.02) * angle + 2 * 0.02, 4)
    (0.264, 0.264)
    >>> round(tube.centreline_m, 6)
    0.25
    """
    share = np.linspace(0.0, 1.0, _BALLS)
    taper = np.clip((share - 0.6) / 0.4, 0.0, 1.0)
    radii = radius_m * (1 - neck * taper**2 * (3 - 2 * taper))
    run = length_m - radii[0] - radii[-1]
    if run <= 0:
        raise ValueError(f"a length of {length_m} m is less than the sum of the end radii")
    along = (share - 0.5) * run
    if np.isinf(bend_radius_m):
        x, y = along, np.zeros_like(along)
    else:
        angle = along / bend_radius_m
        x, y = bend_radius_m * np.sin(angle), bend_radius_m * (1 - np.cos(angle))
    return Tube(np.stack([x, y, np.zeros_like(x)], axis=1), radii, np.array([0.0, -1.0, 0.0]))


def rotation(roll_deg: float = 0.0, tilt_deg: float = 0.0, spin_deg: float = 0.0) -> NDArray[Any]:
    """Return a 3x3 rotation: spin about x, the axis of the fruit, then tilt, then roll.

    Parameters
    ----------
    roll_deg : float
        Angle of the axis in the picture, from x towards y (down), degrees.
    tilt_deg : float
        Angle of the axis out of the picture plane, towards +z, degrees.
    spin_deg : float
        Angle about the axis of the fruit, degrees.

    Examples
    --------
    >>> (rotation(roll_deg=90) @ [1, 0, 0]).round(6).tolist()
    [0.0, 1.0, 0.0]
    >>> (rotation(tilt_deg=90) @ [1, 0, 0]).round(6).tolist()
    [0.0, 0.0, 1.0]
    """
    from scipy.spatial.transform import Rotation

    angles = [roll_deg, -tilt_deg, spin_deg]
    return np.asarray(Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())


_MAX_SLOPE = 0.45  # of the radius along the axis; steeper ends are blunter than a hemisphere


class Variety(StrEnum):
    """Varieties of greenhouse cucumbers by size."""

    LONG = "long"
    MEDIUM = "medium"
    MINI = "mini"
    SMALL = "small"


@dataclass(frozen=True)
class Sizes:
    """Ranges of a variety, in metres.

    Parameters
    ----------
    length_m, radius_m : tuple of float
        Ranges of length and radius.
    bend_radius_m : float
        Least radius of curvature.
    neck : tuple of float
        Range of the relative reduction of the radius at the stem end.
    share : float
        Share of scenes with this variety.
    distance_m : tuple of float
        Range of distances: small fruit are viewed from nearby.
    """

    length_m: tuple[float, float]
    radius_m: tuple[float, float]
    bend_radius_m: float
    neck: tuple[float, float]
    share: float
    distance_m: tuple[float, float]


SIZES = {
    Variety.LONG: Sizes((0.25, 0.40), (0.020, 0.025), 0.15, (0.15, 0.50), 0.42, (0.42, 1.2)),
    Variety.MEDIUM: Sizes((0.18, 0.25), (0.018, 0.023), 0.13, (0.10, 0.40), 0.28, (0.36, 1.1)),
    Variety.MINI: Sizes((0.12, 0.18), (0.015, 0.020), 0.12, (0.05, 0.30), 0.2, (0.32, 0.9)),
    Variety.SMALL: Sizes((0.06, 0.12), (0.012, 0.016), 0.10, (0.05, 0.25), 0.1, (0.3, 0.7)),
}


def variety_of(length_m: float) -> Variety:
    """Return the variety of a fruit by its length.

    Examples
    --------
    >>> [variety_of(length).value for length in (0.069, 0.147, 0.21, 0.38)]
    ['small', 'mini', 'medium', 'long']
    """
    if length_m < 0.10:
        return Variety.SMALL
    if length_m < 0.18:
        return Variety.MINI
    return Variety.MEDIUM if length_m < 0.25 else Variety.LONG


def bent_tube(length_m: float, radii_m: Array, curvature_per_m: Array) -> Tube:
    """Create a planar fruit from radius and curvature along its axis.

    Parameters
    ----------
    length_m : float
        Length of the centreline from pole to pole, metres.
    radii_m : ndarray of float64, shape (K,)
        Radius at K evenly spaced sphere centres, metres.
    curvature_per_m : ndarray of float64, shape (K,)
        Signed curvature at the same points, 1/m.

    Returns
    -------
    Tube
        Tube with `centreline_m` equal to `length_m`, centred at the origin with its chord along x;
        the convex side of the larger bend faces -y.

    Raises
    ------
    ValueError
        If `length_m` is less than the sum of the end radii.

    Examples
    --------
    >>> tube = bent_tube(0.25, np.full(800, 0.02), np.full(800, 1 / 0.30))
    >>> round(tube.centreline_m, 6), round(tube.thread_m, 4)  # as arc_tube(0.25, 0.02, 0.30)
    (0.25, 0.264)
    """
    run = length_m - radii_m[0] - radii_m[-1]
    if run <= 0:
        raise ValueError(f"a length of {length_m} m is less than the sum of the end radii")
    step = run / (len(radii_m) - 1)
    between = (curvature_per_m[1:] + curvature_per_m[:-1]) / 2
    turned = np.concatenate([[0.0], np.cumsum(between * step)])
    if np.maximum(between, 0).sum() < np.maximum(-between, 0).sum():
        turned = -turned
    heading = (turned[1:] + turned[:-1]) / 2
    x = np.concatenate([[0.0], np.cumsum(np.cos(heading))])
    y = np.concatenate([[0.0], np.cumsum(np.sin(heading))])
    centres = np.stack([x, y, np.zeros_like(x)], axis=1)
    centres *= run / polyline_length(centres)
    tube = Tube(centres, radii_m, np.array([0.0, -1.0, 0.0]))
    blossom, stem = tube.poles_m
    angle = np.arctan2(stem[1] - blossom[1], stem[0] - blossom[0])
    turn = rotation(roll_deg=-float(np.rad2deg(angle)))
    level = centres @ turn.T
    poles = tube.poles_m @ turn.T
    middle = np.array([poles[:, 0].mean(), (level[:, 1].min() + level[:, 1].max()) / 2, 0.0])
    return Tube(level - middle, radii_m, tube.outward)


def random_fruit(
    rng: Generator,
    length_m: float,
    variety: Variety | str | None = None,
    *,
    bend_radius_m: float | None = None,
    balls: int = _BALLS,
    slim: float = 1.0,
) -> Tube:
    """Sample a fruit of a given length.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    length_m : float
        Length of the centreline from pole to pole, metres.
    variety : Variety or str, optional
        Determines the ranges of radius, neck and curvature; by default chosen by length.
    bend_radius_m : float, optional
        Mean radius of curvature, metres, infinite for a straight fruit; by default random, mostly
        large.
    balls : int
        Number of spheres.
    slim : float
        Factor for the least radius of the variety.

    Returns
    -------
    Tube
        Tube of `bent_tube` with `centreline_m` equal to `length_m`.

    Raises
    ------
    ValueError
        If `length_m` is less than the sum of the end radii.

    Examples
    --------
    >>> fruit = random_fruit(np.random.default_rng(3), 0.32)
    >>> round(fruit.centreline_m, 6), round(float(2e3 * fruit.radii_m.max()))  # mm across
    (0.32, 41)
    """
    sizes = SIZES[variety_of(length_m) if variety is None else Variety(variety)]
    share = np.linspace(0.0, 1.0, balls)
    radii = _radii(rng, length_m, sizes, share, slim)
    if bend_radius_m is None:
        # Mostly small curvatures, few near the limit.
        bend = rng.beta(1.0, 2.5) / sizes.bend_radius_m
    else:
        bend = 1.0 / bend_radius_m
    return bent_tube(length_m, radii, bend * _bending(rng, share))


def _bending(rng: Generator, share: Array) -> Array:
    if rng.random() < 1 / 8:  # an S-shaped fruit
        shape = np.sin(2 * np.pi * (share - rng.uniform(-0.08, 0.08))) + rng.uniform(-0.25, 0.25)
    else:
        lean, middle = rng.uniform(-0.5, 0.5), rng.uniform(-0.35, 0.35)
        shape = 1 + lean * (2 * share - 1) + middle * np.cos(2 * np.pi * share)
    return np.asarray(shape / np.abs(shape).mean())


def _radii(rng: Generator, length_m: float, sizes: Sizes, share: Array, slim: float) -> Array:
    radius = float(rng.uniform(slim * sizes.radius_m[0], sizes.radius_m[1]))
    bulge = 1 + rng.uniform(-0.04, 0.06) * np.sin(np.pi * share)
    bulge += rng.uniform(-0.025, 0.025) * np.sin(2 * np.pi * share)
    bulge += rng.uniform(-0.012, 0.012) * np.sin(
        rng.uniform(4, 7) * np.pi * share + rng.uniform(0, 6)
    )
    point, neck = rng.uniform(0.10, 0.50), rng.uniform(*sizes.neck)
    run = max(length_m - radius * (2 - point - neck), radius)
    # The blossom end is rounded, the neck tapers.
    width = max(rng.uniform(0.05, 0.15), 2.0 * point * radius / (_MAX_SLOPE * run))
    blossom = 1 - point * np.clip(1 - share / width, 0.0, None) ** 2
    width = max(rng.uniform(0.15, 0.35), 1.5 * neck * radius / (_MAX_SLOPE * run))
    t = np.clip((1 - share) / width, 0.0, 1.0)
    stem = 1 - neck * (1 - t * t * (3 - 2 * t))
    return np.asarray(radius * bulge * blossom * stem)
