"""A leaf: its curved, lobed blade, and where each pixel's ray first meets it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_lab.synthesis.raycast import Hit, ray_grid

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

    Window = tuple[slice, slice]

_LOBES = 5  # a cucumber leaf has five
_TEETH = 41
_NOTCH, _NOTCH_RAD = 0.35, 0.3


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
    teeth : float
        By how much of the ellipse a serrated edge stands out and in, 0 to 0.1; such a leaf has a
        notch where its stalk joins, too.
    """

    centre_m: NDArray[np.float64]
    frame: NDArray[np.float64]
    half_length_m: float
    half_width_m: float
    bend_per_m: tuple[float, float] = (0.0, 0.0)
    lobe: float = 0.0
    teeth: float = 0.0

    def moved(self, turn: NDArray[np.float64], by_m: ArrayLike) -> Leaf:
        """Return the leaf turned about the origin by a 3x3 rotation, then moved by metres."""
        centre = self.centre_m @ turn.T + np.asarray(by_m, dtype=float)
        return replace(self, centre_m=centre, frame=self.frame @ turn.T)


def cast_leaf(leaf: Leaf, camera: Intrinsics) -> Hit | None:
    """Intersect each pixel's ray with a leaf.

    Parameters
    ----------
    leaf : Leaf
        In the camera's coordinates.
    camera : Intrinsics
        The camera.

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
    s, t = ((1 + leaf.lobe + leaf.teeth) * half for half in (leaf.half_length_m, leaf.half_width_m))
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
    if leaf.lobe == leaf.teeth == 0:
        return np.asarray(square <= 1)
    # Only between the innermost and the outermost reach of the edge does the angle matter.
    innermost = 1 - leaf.lobe - leaf.teeth - (_NOTCH if leaf.teeth else 0)
    inside = np.asarray(square <= innermost**2)
    unsure = ~inside & (square <= (1 + leaf.lobe + leaf.teeth) ** 2)
    angle = np.arctan2(q[unsure], p[unsure])
    rim = 1 + leaf.lobe * np.cos(_LOBES * angle)
    if leaf.teeth:
        # A triangular wave, and a notch at the stalk, where the angle is 180 degrees.
        rim += leaf.teeth * (4 * np.abs((_TEETH * angle / (2 * np.pi)) % 1 - 0.5) - 1)
        rim -= _NOTCH * np.exp(-(((np.pi - np.abs(angle)) / _NOTCH_RAD) ** 2))
    inside[unsure] = square[unsure] <= rim * rim
    return inside
