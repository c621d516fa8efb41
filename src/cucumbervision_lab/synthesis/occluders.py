"""What hangs before and behind the fruit: leaves, stems and strings, a bench or a wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_lab.synthesis.raycast import Hit, cast_capsules, ray_grid

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

__all__ = ["Leaf", "Plane", "Stem", "cast_leaf", "cast_stem", "plane_depth"]

LOBES = 5  # a cucumber leaf has five


@dataclass(frozen=True, eq=False)
class Leaf:
    """A thin curved blade: a paraboloid cut by a lobed ellipse.

    Parameters
    ----------
    centre_m : ndarray of float64, shape (3,)
        Camera coordinates, metres.
    frame : ndarray of float64, shape (3, 3)
        Rows: unit vectors along the blade (to its tip), across it, and off it.
    half_length_m, half_width_m : float
        Half axes of the ellipse, metres.
    bend_per_m : tuple of float
        Curvatures along and across, 1/m; the blade's height off its middle is
        (bend_along s² + bend_across t²) / 2.
    lobe : float
        By how much of the ellipse the five lobes stand out and in, 0 to 0.5.
    """

    centre_m: NDArray[np.float64]
    frame: NDArray[np.float64]
    half_length_m: float
    half_width_m: float
    bend_per_m: tuple[float, float] = (0.0, 0.0)
    lobe: float = 0.0

    def moved(self, turn: NDArray[np.float64], by_m: ArrayLike) -> Leaf:
        """Give the same leaf turned about the origin by a 3x3 rotation, then moved by metres."""
        return Leaf(
            self.centre_m @ turn.T + np.asarray(by_m, dtype=float),
            self.frame @ turn.T,
            self.half_length_m,
            self.half_width_m,
            self.bend_per_m,
            self.lobe,
        )


@dataclass(frozen=True, eq=False)
class Stem:
    """A round rod along a polyline: a stem, a leaf's stalk, a string.

    Parameters
    ----------
    vertices_m : ndarray of float64, shape (K, 3)
        Camera coordinates, metres.
    radius_m : float
        Metres.
    """

    vertices_m: NDArray[np.float64]
    radius_m: float

    def moved(self, turn: NDArray[np.float64], by_m: ArrayLike) -> Stem:
        """Give the same rod turned about the origin by a 3x3 rotation, then moved by metres."""
        return Stem(self.vertices_m @ turn.T + np.asarray(by_m, dtype=float), self.radius_m)


@dataclass(frozen=True, eq=False)
class Plane:
    """A bench, a wall.

    Parameters
    ----------
    point_m : ndarray of float64, shape (3,)
        Any point of it, camera coordinates, metres.
    normal : ndarray of float64, shape (3,)
        Any vector at right angles to it.
    """

    point_m: NDArray[np.float64]
    normal: NDArray[np.float64]

    @classmethod
    def facing(cls, distance_m: float, tilt_deg: float = 0.0, turn_deg: float = 0.0) -> Plane:
        """Make a plane that meets the optical axis at a distance.

        Parameters
        ----------
        distance_m : float
            Depth on the optical axis, metres.
        tilt_deg, turn_deg : float
            Lean about the x axis (the upper part away) and the y axis (the right part away),
            degrees.

        Examples
        --------
        >>> Plane.facing(0.5).normal.tolist()
        [0.0, 0.0, -1.0]
        """
        up, right = np.tan(np.deg2rad([tilt_deg, turn_deg]))
        return cls(np.array([0.0, 0.0, distance_m]), np.array([right, -up, -1.0]) + 0.0)

    def moved(self, turn: NDArray[np.float64], by_m: ArrayLike) -> Plane:
        """Give the same plane turned about the origin by a 3x3 rotation, then moved by metres."""
        return Plane(
            turn @ self.point_m + np.asarray(by_m, dtype=float),
            turn @ self.normal,
        )


def cast_leaf(leaf: Leaf, camera: Intrinsics) -> Hit | None:
    """Meet a leaf.

    Parameters
    ----------
    leaf : Leaf
        In the camera's coordinates.
    camera : Intrinsics
        Who looks.

    Returns
    -------
    Hit or None
        The nearer of the two points where a ray meets the paraboloid inside the outline; None
        when no pixel sees the leaf.

    Raises
    ------
    ValueError
        If the leaf reaches behind the camera.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
    >>> flat = Leaf(np.array([0.0, 0.0, 0.6]), np.eye(3), 0.05, 0.04)
    >>> hit = cast_leaf(flat, camera)
    >>> round(float(hit.depth_m[hit.mask].mean()), 6)
    0.6
    """
    grid = ray_grid(camera)
    window = grid.window(*_bounds(leaf))
    if window is None:
        return None
    x, y = grid.x[window], grid.y[window]
    # A point z (x, y, 1) in the leaf's frame is z d - c.
    d_s, d_t, d_n = (f[0] * x + f[1] * y + f[2] for f in leaf.frame.tolist())
    c_s, c_t, c_n = (leaf.frame @ leaf.centre_m).tolist()
    k_s, k_t = leaf.bend_per_m
    a = (k_s * d_s * d_s + k_t * d_t * d_t) / 2
    b = d_n + k_s * c_s * d_s + k_t * c_t * d_t
    c = c_n + (k_s * c_s * c_s + k_t * c_t * c_t) / 2
    # a z² - b z + c = 0, in the form that stays good when a vanishes: z = 2 c / (b ± root).
    square = b * b - 4 * a * c
    root = np.sqrt(np.maximum(square, 0.0))
    depth = np.full(x.shape, np.inf)
    for below in (b + root, b - root):
        z = 2 * c / np.where(below == 0, np.nan, below)
        inside = (z > 0) & (square >= 0) & _in_outline(leaf, z * d_s - c_s, z * d_t - c_t)
        np.copyto(depth, z, where=inside & (z < depth))
    return Hit(window, depth, np.zeros(x.shape, np.int32))


def _bounds(leaf: Leaf) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # The rays to the corners of the box that holds the blade hold those to the blade.
    s, t = ((1 + leaf.lobe) * half for half in (leaf.half_length_m, leaf.half_width_m))
    rise = [k * half**2 / 2 for k, half in zip(leaf.bend_per_m, (s, t), strict=True)]
    low, high = sum(min(r, 0.0) for r in rise), sum(max(r, 0.0) for r in rise)
    corners = np.array([(p, q, n) for p in (-s, s) for q in (-t, t) for n in (low, high)])
    corners = leaf.centre_m + corners @ leaf.frame
    if corners[:, 2].min() <= 0:
        raise ValueError("a leaf reaches behind the camera")
    rays = corners[:, :2] / corners[:, 2:]
    return rays.min(axis=0), rays.max(axis=0)


def _in_outline(leaf: Leaf, s: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.bool_]:
    p, q = s / leaf.half_length_m, t / leaf.half_width_m
    square = p * p + q * q
    if leaf.lobe == 0:
        return np.asarray(square <= 1)
    inside = np.asarray(square <= (1 - leaf.lobe) ** 2)
    # Only between the innermost and the outermost reach of the lobes does the angle matter.
    unsure = ~inside & (square <= (1 + leaf.lobe) ** 2)
    rim = 1 + leaf.lobe * np.cos(LOBES * np.arctan2(q[unsure], p[unsure]))
    inside[unsure] = square[unsure] <= rim * rim
    return inside


def cast_stem(stem: Stem, camera: Intrinsics) -> Hit | None:
    """Meet a stem or string; as `cast_capsules`."""
    return cast_capsules(stem.vertices_m, stem.radius_m, camera)


def plane_depth(plane: Plane, camera: Intrinsics) -> NDArray[np.float64]:
    """Give the depth of a plane in each pixel.

    Returns
    -------
    ndarray of float64, shape (H, W)
        Metres along z; infinite where the ray never meets it.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(3, 3, 2.0, 2.0, 1.0, 1.0)
    >>> plane_depth(Plane.facing(0.5, tilt_deg=45.0), camera)[:, 1].round(3).tolist()
    [1.0, 0.5, 0.333]
    """
    grid = ray_grid(camera)
    nx, ny, nz = plane.normal.tolist()
    slant = nx * grid.x + ny * grid.y + nz
    with np.errstate(divide="ignore"):
        depth: NDArray[np.float64] = float(plane.normal @ plane.point_m) / slant
    depth[~(depth > 0)] = np.inf
    return depth
