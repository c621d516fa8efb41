"""Scenes of fruit, leaves, stems and planes: ray casting, and their exact ground truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.tube.shape import points_along
from cucumbervision_lab.arrays import Array, Array32, Mask, Pixels
from cucumbervision_lab.scenes.bodies import Tube

Window = tuple[slice, slice]


_COARSE_BALLS = 100


@dataclass(frozen=True, eq=False)
class Hit:
    """Intersection of the pixels' rays with one body.

    Parameters
    ----------
    window : tuple of slice
        Rows and columns of the picture, shape (h, w).
    depth_m : ndarray of float64, shape (h, w)
        Depth along z in metres; infinite if the ray misses.
    part : ndarray of int32, shape (h, w)
        Index of the sphere or segment; 0 if the ray misses.
    """

    window: Window
    depth_m: Array
    part: NDArray[np.int32]

    @property
    def mask(self) -> Mask:
        """Pixels of the window that see the body, shape (h, w)."""
        return np.isfinite(self.depth_m)

    def add(self, window: Window, depth_m: Array, part: int) -> None:
        """Merge a further part, keeping the nearer intersection of each pixel."""
        rows, columns = self.window
        overlap = np.s_[
            window[0].start - rows.start : window[0].stop - rows.start,
            window[1].start - columns.start : window[1].stop - columns.start,
        ]
        closer = depth_m < self.depth_m[overlap]
        self.depth_m[overlap][closer] = depth_m[closer]
        self.part[overlap][closer] = part


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Rays of a camera's pixels, and their range in each column and row.

    Parameters
    ----------
    x, y : ndarray of float64, shape (H, W)
        Undistorted rays (x/z, y/z); read-only.
    columns, rows : tuple of two ndarrays of float64, shape (W,) and (H,)
        Least and largest x of each column, y of each row.
    """

    x: Array
    y: Array
    columns: tuple[Array, Array]
    rows: tuple[Array, Array]

    def window(self, lower: ArrayLike, upper: ArrayLike) -> Window | None:
        """Return the window of pixels whose rays can lie between two corners (x, y), or None."""
        (x_low, y_low), (x_high, y_high) = np.asarray(lower), np.asarray(upper)
        first_column, end_column = (
            np.searchsorted(self.columns[1], x_low),
            np.searchsorted(self.columns[0], x_high),
        )
        top, bottom = np.searchsorted(self.rows[1], y_low), np.searchsorted(self.rows[0], y_high)
        if first_column >= end_column or top >= bottom:
            return None
        return slice(int(top), int(bottom)), slice(int(first_column), int(end_column))


@lru_cache(maxsize=8)
def ray_grid(camera: Intrinsics) -> RayGrid:
    """Return the rays of all pixels of a camera; the result is cached.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> grid = ray_grid(Intrinsics(4, 2, 10.0, 10.0, 1.0, 1.0))
    >>> grid.x[0].tolist()
    [-0.1, 0.0, 0.1, 0.2]
    """
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    x, y = (np.asarray(r, dtype=np.float64) for r in camera.rays(u, v))
    x.flags.writeable = y.flags.writeable = False
    # Distortion can make rays slightly non-monotonic, but the binary search needs sorted values.
    columns = tuple(np.maximum.accumulate(r) for r in (x.min(axis=0), x.max(axis=0)))
    rows = tuple(np.maximum.accumulate(r) for r in (y.min(axis=1), y.max(axis=1)))
    return RayGrid(x, y, (columns[0], columns[1]), (rows[0], rows[1]))


def scaled_camera(camera: Intrinsics, factor: float) -> Intrinsics:
    """Return a camera with a scaled picture size; 0.5 halves width and height.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> half = scaled_camera(Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5), 0.5)
    >>> half.size, half.fx_px, half.cx_px
    ((320, 240), 300.0, 159.5)
    """
    # Pixel centres are integers, so the centre of 2 x 2 pixels is at 0.5.
    return replace(
        camera,
        width=max(int(camera.width * factor), 1),
        height=max(int(camera.height * factor), 1),
        fx_px=camera.fx_px * factor,
        fy_px=camera.fy_px * factor,
        cx_px=camera.cx_px * factor + (factor - 1) / 2,
        cy_px=camera.cy_px * factor + (factor - 1) / 2,
    )


def _ball_bounds(centre_m: Array, radius_m: float) -> tuple[Array, Array]:
    """Return the bounding rectangle of a projected sphere, in ray coordinates.

    Parameters
    ----------
    centre_m : ndarray of float64, shape (3,)
        Camera coordinates, metres.
    radius_m : float
        Metres.

    Returns
    -------
    low, high : ndarray of float64, shape (2,)
        Minimum and maximum x/z and y/z of the sphere.

    Raises
    ------
    ValueError
        If the sphere extends behind the camera.

    Examples
    --------
    A sphere on the optical axis has a half angle of asin(r / z):

    >>> lower, upper = _ball_bounds(np.array([0.0, 0.0, 0.5]), 0.3)
    >>> upper.round(6).tolist()
    [0.75, 0.75]
    """
    across, z = centre_m[:2], float(centre_m[2])
    if z <= radius_m:
        raise ValueError("a body extends behind the camera")
    # Tangent planes through the camera centre, parallel to the other image axis.
    root = radius_m * np.sqrt(across**2 + z * z - radius_m**2)
    scale = z * z - radius_m**2
    return (across * z - root) / scale, (across * z + root) / scale


def cast_tube(tube: Tube, camera: Intrinsics) -> Hit | None:
    """Intersect each pixel's ray with a swept sphere.

    Parameters
    ----------
    tube : Tube
        In the camera's coordinates.
    camera : Intrinsics
        The camera.

    Returns
    -------
    Hit or None
        Nearest sphere of each pixel with its index in `part`; None if the tube is not visible.

    Raises
    ------
    ValueError
        If the tube extends behind the camera.

    Notes
    -----
    A coarse pass with slightly enlarged spheres finds the pixels; a binary search among the
    neighbours then finds the exact sphere (depth has a single minimum along the axis).

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.scenes.bodies import arc_tube
    >>> tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.5))
    >>> hit = cast_tube(tube, Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0))
    >>> round(float(hit.depth_m.min()), 6)
    0.48
    """
    grid = ray_grid(camera)
    step = max(1, len(tube.radii_m) // _COARSE_BALLS)
    coarse = np.unique(np.append(np.arange(0, len(tube.radii_m), step), len(tube.radii_m) - 1))
    gap = np.linalg.norm(np.diff(tube.centres_m[coarse], axis=0), axis=1).max()
    swell = 1.0 if step == 1 else 1.0 + 2 * (gap / tube.radii_m.min()) ** 2 / 8
    windows = [
        grid.window(*_ball_bounds(tube.centres_m[k], swell * tube.radii_m[k])) for k in coarse
    ]
    hit = _empty_hit(windows)
    if hit is None:
        return None
    for k, window in zip(coarse.tolist(), windows, strict=True):
        if window is not None:
            x, y = grid.x[window], grid.y[window]
            hit.add(window, _ball(x, y, tube.centres_m[k], swell * tube.radii_m[k]), k)
    if step > 1:
        _refine(tube, step, (grid.x[hit.window], grid.y[hit.window]), hit.depth_m, hit.part)
    return hit


def _empty_hit(windows: Sequence[Window | None]) -> Hit | None:
    present = [w for w in windows if w is not None]
    if not present:
        return None
    rows = slice(min(w[0].start for w in present), max(w[0].stop for w in present))
    columns = slice(min(w[1].start for w in present), max(w[1].stop for w in present))
    shape = rows.stop - rows.start, columns.stop - columns.start
    return Hit((rows, columns), np.full(shape, np.inf), np.zeros(shape, np.int32))


def _ball(x: Array, y: Array, centre_m: Array, radius_m: float) -> Array:
    cx, cy, cz = centre_m.tolist()
    a = x * x + y * y + 1
    b = x * cx + y * cy + cz
    disc = b * b - a * (cx * cx + cy * cy + cz * cz - radius_m * radius_m)
    z: Array = (b - np.sqrt(np.maximum(disc, 0))) / a
    z[disc <= 0] = np.inf
    return z


def _refine(
    tube: Tube, step: int, rays: tuple[Array, Array], depth: Array, part: NDArray[np.int32]
) -> None:
    finite = np.isfinite(depth)
    x, y, k = rays[0][finite], rays[1][finite], part[finite]
    a = x * x + y * y + 1
    centres, radii = tube.centres_m, tube.radii_m
    constant = (centres * centres).sum(axis=1) - radii * radii
    cx, cy, cz = np.ascontiguousarray(centres.T)

    def score(k: NDArray[np.int32]) -> Array:
        b = x * cx[k] + y * cy[k] + cz[k]
        disc = b * b - a * constant[k]
        # A miss scores worse than any hit, increasing with its distance.
        met = (b - np.sqrt(np.maximum(disc, 0))) / a
        return np.asarray(np.where(disc > 0, met, 1e3 - disc))

    lower = np.maximum(k - step, 0)
    upper = np.minimum(k + step, len(radii) - 1)
    while (upper > lower).any():
        middle = (lower + upper) // 2
        ahead = score(np.minimum(middle + 1, len(radii) - 1)) < score(middle)
        lower = np.where(ahead & (middle < upper), middle + 1, lower)
        upper = np.where(ahead, upper, np.maximum(middle, lower))
    best = score(lower)
    depth[finite] = np.where(best < 1e2, best, np.inf)
    part[finite] = np.where(best < 1e2, lower, 0)


def cast_stem(stem: Stem, camera: Intrinsics) -> Hit | None:
    """Intersect each pixel's ray with a stem or string with round ends and joints.

    Parameters
    ----------
    stem : Stem
        In the camera's coordinates.
    camera : Intrinsics
        The camera.

    Returns
    -------
    Hit or None
        Intersection with the segment index in `part`; None if the stem is not visible.

    Raises
    ------
    ValueError
        If the stem extends behind the camera.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> rod = Stem(np.array([[0.0, -0.1, 0.5], [0.0, 0.1, 0.5]]), 0.005)
    >>> hit = cast_stem(rod, Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0))
    >>> round(float(hit.depth_m.min()), 6)
    0.495
    """
    vertices_m, radius_m = stem.vertices_m, stem.radius_m
    grid = ray_grid(camera)
    bounds = [_ball_bounds(vertex, radius_m) for vertex in vertices_m]
    windows = [
        grid.window(np.minimum(a[0], b[0]), np.maximum(a[1], b[1])) for a, b in pairwise(bounds)
    ]
    hit = _empty_hit(windows)
    if hit is None:
        return None
    for k, window in enumerate(windows):
        if window is not None:
            x, y = grid.x[window], grid.y[window]
            start, end = vertices_m[k], vertices_m[k + 1]
            depth = _cylinder(x, y, start, end, radius_m)
            for vertex in (start, end):
                np.minimum(depth, _ball(x, y, vertex, radius_m), out=depth)
            hit.add(window, depth, k)
    return hit


def _cylinder(x: Array, y: Array, start_m: Array, end_m: Array, radius_m: float) -> Array:
    axis = end_m - start_m
    length = float(np.linalg.norm(axis))
    ax, ay, az = (axis / length).tolist()
    sx, sy, sz = start_m.tolist()
    # Components of ray and start point perpendicular to the axis: |z across - from|² = r².
    along = x * ax + y * ay + az
    foot = sx * ax + sy * ay + sz * az
    a = x * x + y * y + 1 - along * along
    b = x * sx + y * sy + sz - along * foot
    disc = b * b - a * (sx * sx + sy * sy + sz * sz - foot * foot - radius_m * radius_m)
    hit = (disc > 0) & (a > 0)
    z = (b - np.sqrt(np.where(hit, disc, 0.0))) / np.where(hit, a, 1.0)
    reach = z * along - foot
    return np.where(hit & (reach >= 0) & (reach <= length), z, np.inf)


@dataclass(frozen=True, eq=False)
class Stem:
    """A cylinder along a polyline: stem, stalk or string.

    Parameters
    ----------
    vertices_m : ndarray of float64, shape (K, 3)
        Camera coordinates, metres.
    radius_m : float
        Metres.
    role : str
        'stem', 'stalk', 'string', 'blossom' or 'crate'.
    """

    vertices_m: Array
    radius_m: float
    role: str = "stem"

    def moved(self, turn: Array, by_m: ArrayLike) -> Stem:
        """Return the stem rotated about the origin by a 3x3 matrix, then translated by metres."""
        return replace(self, vertices_m=self.vertices_m @ turn.T + np.asarray(by_m, dtype=float))


@dataclass(frozen=True, eq=False)
class Plane:
    """An infinite plane, such as a bench or a wall.

    Parameters
    ----------
    point_m : ndarray of float64, shape (3,)
        A point of the plane, camera coordinates, metres.
    normal : ndarray of float64, shape (3,)
        A normal vector of any length.
    """

    point_m: Array
    normal: Array

    @classmethod
    def facing(cls, distance_m: float, tilt_deg: float = 0.0, turn_deg: float = 0.0) -> Plane:
        """Create a plane from its distance on the optical axis.

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

    def unit_normal(self) -> Array:
        """Return the unit normal towards the camera, shape (3,)."""
        normal = self.normal / np.linalg.norm(self.normal)
        return np.asarray(normal * -np.sign(normal @ self.point_m))

    def tile_axes(self) -> Array:
        """Return two unit vectors in the plane, along which its material is tiled, shape (2, 3)."""
        normal = self.unit_normal()
        aside = np.cross(normal, (0.0, 1.0, 0.15) if abs(normal[1]) < 0.9 else (1.0, 0.1, 0.0))
        aside /= np.linalg.norm(aside)
        return np.stack([aside, np.cross(normal, aside)])

    def moved(self, turn: Array, by_m: ArrayLike) -> Plane:
        """Return the plane rotated about the origin by a 3x3 matrix, then translated by metres."""
        return Plane(turn @ self.point_m + np.asarray(by_m, dtype=float), turn @ self.normal)


def cast_plane(plane: Plane, camera: Intrinsics) -> Hit:
    """Intersect each pixel's ray with a plane.

    Returns
    -------
    Hit
        Intersection over the whole picture; infinite if the ray misses.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(3, 3, 2.0, 2.0, 1.0, 1.0)
    >>> cast_plane(Plane.facing(0.5, tilt_deg=45.0), camera).depth_m[:, 1].round(3).tolist()
    [1.0, 0.5, 0.333]
    """
    grid = ray_grid(camera)
    nx, ny, nz = plane.normal.tolist()
    slant = nx * grid.x + ny * grid.y + nz
    with np.errstate(divide="ignore"):
        depth: Array = float(plane.normal @ plane.point_m) / slant
    depth[~(depth > 0)] = np.inf
    window = slice(0, camera.height), slice(0, camera.width)
    return Hit(window, depth, np.zeros(depth.shape, np.int32))


_LOBES = 5  # number of lobes of a cucumber leaf


@dataclass(frozen=True, eq=False)
class Leaf:
    """A thin curved blade: a paraboloid with a lobed elliptic outline.

    Parameters
    ----------
    centre_m : ndarray of float64, shape (3,)
        Camera coordinates, metres.
    frame : ndarray of float64, shape (3, 3)
        Rows: unit vectors along the blade (to its tip), across it, and off it.
    half_length_m, half_width_m : float
        Half axes of the ellipse, metres.
    bend_per_m : tuple of float
        Curvatures along and across, 1/m; the height above the tangent plane is
        (bend_along s² + bend_across t²) / 2.
    lobe : float
        Relative amplitude of the five lobes, 0 to 0.5.
    role : str
        'leaf' or 'blossom'.
    """

    centre_m: Array
    frame: Array
    half_length_m: float
    half_width_m: float
    bend_per_m: tuple[float, float] = (0.0, 0.0)
    lobe: float = 0.0
    role: str = "leaf"

    def moved(self, turn: Array, by_m: ArrayLike) -> Leaf:
        """Return the leaf rotated about the origin by a 3x3 matrix, then translated by metres."""
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
        Nearer intersection with the paraboloid inside the outline; None if the leaf is not visible.

    Raises
    ------
    ValueError
        If the leaf extends behind the camera.

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
    # In the leaf's frame, the point z (x, y, 1) is z d - c.
    d_s, d_t, d_n = (f[0] * x + f[1] * y + f[2] for f in leaf.frame.tolist())
    c_s, c_t, c_n = (leaf.frame @ leaf.centre_m).tolist()
    k_s, k_t = leaf.bend_per_m
    a = (k_s * d_s * d_s + k_t * d_t * d_t) / 2
    b = d_n + k_s * c_s * d_s + k_t * c_t * d_t
    c = c_n + (k_s * c_s * c_s + k_t * c_t * c_t) / 2
    # Numerically stable solution of a z² - b z + c = 0 for small a: z = 2 c / (b ± root).
    square = b * b - 4 * a * c
    root = np.sqrt(np.maximum(square, 0.0))
    depth = np.full(x.shape, np.inf)
    for below in (b + root, b - root):
        z = 2 * c / np.where(below == 0, np.nan, below)
        inside = (z > 0) & (square >= 0) & _in_outline(leaf, z * d_s - c_s, z * d_t - c_t)
        np.copyto(depth, z, where=inside & (z < depth))
    return Hit(window, depth, np.zeros(x.shape, np.int32))


def _bounds(leaf: Leaf) -> tuple[Array, Array]:
    # The projection of the bounding box contains the projection of the blade.
    s, t = ((1 + leaf.lobe) * half for half in (leaf.half_length_m, leaf.half_width_m))
    rise = [k * half**2 / 2 for k, half in zip(leaf.bend_per_m, (s, t), strict=True)]
    lowest, highest = sum(min(r, 0.0) for r in rise), sum(max(r, 0.0) for r in rise)
    corners = np.array([(p, q, n) for p in (-s, s) for q in (-t, t) for n in (lowest, highest)])
    corners = leaf.centre_m + corners @ leaf.frame
    if corners[:, 2].min() <= 0:
        raise ValueError("a leaf extends behind the camera")
    rays = corners[:, :2] / corners[:, 2:]
    return rays.min(axis=0), rays.max(axis=0)


def _in_outline(leaf: Leaf, s: Array, t: Array) -> Mask:
    p, q = s / leaf.half_length_m, t / leaf.half_width_m
    square = p * p + q * q
    if leaf.lobe == 0:
        return np.asarray(square <= 1)
    # Evaluate the outline only between the inner and outer radius of the edge.
    inside = np.asarray(square <= (1 - leaf.lobe) ** 2)
    unsure = ~inside & (square <= (1 + leaf.lobe) ** 2)
    rim = 1 + leaf.lobe * np.cos(_LOBES * np.arctan2(q[unsure], p[unsure]))
    inside[unsure] = square[unsure] <= rim * rim
    return inside


_KEYPOINT_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


class Kind(IntEnum):
    """Kind of body that a pixel sees."""

    NOTHING = 0
    PLANE = 1
    FRUIT = 2
    LEAF = 3
    STEM = 4


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies in the coordinates of one camera.

    Parameters
    ----------
    fruit : tuple of Tube
        The fruit.
    leaves : tuple of Leaf
        Leaves in front of and behind the fruit.
    stems : tuple of Stem
        Stems, stalks and strings.
    planes : tuple of Plane
        Benches and walls.
    """

    fruit: tuple[Tube, ...]
    leaves: tuple[Leaf, ...] = ()
    stems: tuple[Stem, ...] = ()
    planes: tuple[Plane, ...] = ()

    @classmethod
    def of(cls, *fruit: Tube, backdrop_m: float | None = None) -> Scene:
        """Create a scene of fruit, optionally in front of a plane that faces the camera."""
        return cls(fruit, planes=() if backdrop_m is None else (Plane.facing(backdrop_m),))

    def moved(self, turn: Array, by_m: ArrayLike) -> Scene:
        """Return the scene rotated about the origin by a 3x3 matrix, then translated by metres."""
        moved = (tuple(body.moved(turn, by_m) for body in bodies) for bodies in vars(self).values())
        return Scene(*moved)


@dataclass(frozen=True, eq=False)
class View:
    """Visible body of each pixel, and the unoccluded mask of each fruit.

    Parameters
    ----------
    depth_m : ndarray of float64, shape (H, W)
        Depth along z in metres; 0 for no object.
    share : ndarray of float32, shape (H, W)
        Position along the fruit's axis, 0 at the blossom end, 1 at the stem end; 0 elsewhere.
    normal : ndarray of float32, shape (H, W, 3)
        Outward unit normal of the fruit's surface, camera coordinates; 0 elsewhere.
    kind : ndarray of uint8, shape (H, W)
        A `Kind`.
    body : ndarray of int32, shape (H, W)
        Index of the body within its kind; -1 for no object.
    amodal : tuple of ndarray of bool, shape (H, W)
        Mask of each fruit without occlusion, inside the picture.
    """

    depth_m: Array
    share: Array32
    normal: Array32
    kind: Pixels
    body: NDArray[np.int32]
    amodal: tuple[Mask, ...]

    def mask(self, index: int) -> Mask:
        """Return the visible pixels of one fruit, shape (H, W)."""
        return np.asarray((self.kind == Kind.FRUIT) & (self.body == index))


@dataclass(frozen=True, eq=False)
class FruitTruth:
    """Exact ground truth of one fruit in one view.

    Parameters
    ----------
    centreline_m, thread_m, chord_m : float
        The three lengths, metres.
    axis_m : ndarray of float64, shape (K, 3)
        Central axis from blossom end to stem end, camera coordinates, metres.
    radius_m : ndarray of float64, shape (K,)
        Radius at each vertex of the axis, 0 at both poles, metres.
    visible, amodal : ndarray of bool, shape (H, W)
        Visible pixels, and pixels without occlusion.
    hidden_share : float
        Occluded share of the amodal pixels, 0 to 1.
    cut_off : bool
        Whether the mask touches the picture's border.
    keypoints_px : ndarray of float64, shape (5, 2)
        Projected points of the axis at 0, 1/4, 1/2, 3/4 and 1 of its length, KP0 (blossom end) to
        KP4 (stem end), (u, v) in pixels.
    keypoint_visibility : ndarray of int8, shape (5,)
        2 visible, 1 hidden by another body or the fruit itself, 0 outside the picture (COCO).
    """

    centreline_m: float
    thread_m: float
    chord_m: float
    axis_m: Array
    radius_m: Array
    visible: Mask
    amodal: Mask
    hidden_share: float
    cut_off: bool
    keypoints_px: Array
    keypoint_visibility: NDArray[np.int8]


def render(scene: Scene, camera: Intrinsics) -> View:
    """Render a scene by ray casting.

    Parameters
    ----------
    scene : Scene
        Scene in camera coordinates.
    camera : Intrinsics
        The camera, including lens distortion.

    Returns
    -------
    View
        Visible body of each pixel.

    Raises
    ------
    ValueError
        If a body extends behind the camera.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.scenes.bodies import arc_tube
    >>> from cucumbervision_lab.scenes.scene import Plane, Stem
    >>> tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.5))
    >>> string = Stem(np.array([[0.0, -0.3, 0.45], [0.0, 0.3, 0.45]]), 0.002)
    >>> camera = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
    >>> view = render(Scene((tube,), stems=(string,), planes=(Plane.facing(0.8),)), camera)
    >>> Kind(view.kind[120, 160]).name, Kind(view.kind[120, 180]).name, float(view.depth_m[0, 0])
    ('STEM', 'FRUIT', 0.8)
    """
    shape = camera.height, camera.width
    depth, part = np.full(shape, np.inf), np.zeros(shape, np.int32)
    kind, body = np.zeros(shape, np.uint8), np.full(shape, -1, np.int32)
    amodal = tuple(np.zeros(shape, np.bool_) for _ in scene.fruit)
    for what, index, hit in _hits(scene, camera):
        if hit is None:
            continue
        if what is Kind.FRUIT:
            amodal[index][hit.window] = hit.mask
        closer = hit.depth_m < depth[hit.window]
        np.copyto(depth[hit.window], hit.depth_m, where=closer)
        np.copyto(part[hit.window], hit.part, where=closer)
        kind[hit.window][closer], body[hit.window][closer] = what, index
    depth[np.isinf(depth)] = 0.0
    share, normal = np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32)
    grid = ray_grid(camera)
    for index, tube in enumerate(scene.fruit):
        v, u = np.nonzero((kind == Kind.FRUIT) & (body == index))
        k, z = part[v, u], depth[v, u]
        points = np.stack([grid.x[v, u] * z, grid.y[v, u] * z, z], axis=1)
        share[v, u] = k / (len(tube.radii_m) - 1)
        normal[v, u] = (points - tube.centres_m[k]) / tube.radii_m[k, None]
    return View(depth, share, normal, kind, body, amodal)


def _hits(scene: Scene, camera: Intrinsics) -> Iterator[tuple[Kind, int, Hit | None]]:
    for index, tube in enumerate(scene.fruit):
        yield Kind.FRUIT, index, cast_tube(tube, camera)
    for index, leaf in enumerate(scene.leaves):
        yield Kind.LEAF, index, cast_leaf(leaf, camera)
    for index, stem in enumerate(scene.stems):
        yield Kind.STEM, index, cast_stem(stem, camera)
    for index, plane in enumerate(scene.planes):
        yield Kind.PLANE, index, cast_plane(plane, camera)


def truth_of(scene: Scene, camera: Intrinsics, view: View | None = None) -> tuple[FruitTruth, ...]:
    """Return the ground truth of each fruit of a scene.

    Parameters
    ----------
    scene : Scene
        Scene in camera coordinates.
    camera : Intrinsics
        The camera.
    view : View, optional
        Result of `render`, if available.

    Returns
    -------
    tuple of FruitTruth
        In the order of `scene.fruit`. A fruit outside the picture has empty masks and a
        `hidden_share` of 0.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.scenes.bodies import arc_tube
    >>> tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.5))
    >>> truth, = truth_of(Scene((tube,)), Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0))
    >>> truth.keypoints_px.round(1)[:, 0].tolist(), truth.keypoint_visibility.tolist()
    ([100.0, 130.0, 160.0, 190.0, 220.0], [2, 2, 2, 2, 2])
    """
    rendered = render(scene, camera) if view is None else view
    return tuple(_truth(tube, k, camera, rendered) for k, tube in enumerate(scene.fruit))


def reaches_border(mask: Mask) -> bool:
    """Return whether a mask of shape (H, W) touches the picture's border.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[2, 2:5] = True
    >>> reaches_border(mask), reaches_border(mask[:3])
    (False, True)
    """
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def _truth(tube: Tube, index: int, camera: Intrinsics, view: View) -> FruitTruth:
    visible, amodal = view.mask(index), view.amodal[index]
    area_px = int(amodal.sum())
    axis = tube.axis_m
    points = points_along(axis, _KEYPOINT_SHARES)
    pixels = camera.project(points)
    return FruitTruth(
        centreline_m=tube.centreline_m,
        thread_m=tube.thread_m,
        chord_m=tube.chord_m,
        axis_m=axis,
        radius_m=np.concatenate([[0.0], tube.radii_m, [0.0]]),
        visible=visible,
        amodal=amodal,
        hidden_share=1.0 - int(visible.sum()) / area_px if area_px else 0.0,
        cut_off=reaches_border(amodal),
        keypoints_px=pixels,
        keypoint_visibility=_visibility(points, pixels, tube, visible, view.depth_m, camera),
    )


_GROWN_SHARE = 0.2
"""Half the width of a stalk or blossom relative to the fruit's largest radius."""


def _visibility(
    points_m: Array, pixels: Array, tube: Tube, visible: Mask, depth_m: Array, camera: Intrinsics
) -> NDArray[np.int8]:
    height, width = visible.shape
    thick_m = float(tube.radii_m.max())
    visibility = np.zeros(len(pixels), np.int8)
    # Inner points lie below the skin; a pole lies on the skin or is hidden by the fruit itself.
    allowed = [0.5 * tube.radii_m[0], *[np.inf] * (len(pixels) - 2), 0.5 * tube.radii_m[-1]]
    for k, (u, v) in enumerate(np.rint(pixels).astype(int).tolist()):
        if not (0 <= u < width and 0 <= v < height):
            continue
        # Include neighbouring pixels: the projected pole may miss the mask by a pixel, and an end
        # covered only by its stalk or blossom still counts as visible.
        reach_px = 1
        if k in (0, len(pixels) - 1):
            reach_px += int(
                np.ceil(_GROWN_SHARE * thick_m * camera.fx_px / max(points_m[k, 2], 1e-6))
            )
        window = np.s_[
            max(v - reach_px, 0) : v + reach_px + 1, max(u - reach_px, 0) : u + reach_px + 1
        ]
        fruit = visible[window]
        behind = points_m[k, 2] - depth_m[window]
        visibility[k] = 2 if (fruit & (behind <= allowed[k])).any() else 1
    return visibility
