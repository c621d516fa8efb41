"""Scenes of fruit, leaves, stems and planes, and their exact ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.tube.shape import points_along
from cucumbervision_lab.arrays import Array, Array32, Mask, Pixels
from cucumbervision_lab.scenes import raycast
from cucumbervision_lab.scenes.bodies import Tube
from cucumbervision_lab.scenes.raycast import Hit

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
    leaves: tuple[raycast.Leaf, ...] = ()
    stems: tuple[raycast.Stem, ...] = ()
    planes: tuple[raycast.Plane, ...] = ()

    @classmethod
    def of(cls, *fruit: Tube, backdrop_m: float | None = None) -> Scene:
        """Create a scene of fruit, optionally in front of a plane that faces the camera."""
        return cls(fruit, planes=() if backdrop_m is None else (raycast.Plane.facing(backdrop_m),))

    def moved(self, turn: Array, by_m: ArrayLike) -> Scene:
        """Return the scene rotated about the origin by a 3x3 matrix, then translated by metres."""
        return Scene(
            tuple(body.moved(turn, by_m) for body in self.fruit),
            tuple(body.moved(turn, by_m) for body in self.leaves),
            tuple(body.moved(turn, by_m) for body in self.stems),
            tuple(body.moved(turn, by_m) for body in self.planes),
        )


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
    >>> from cucumbervision_lab.scenes.raycast import Plane, Stem
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
    grid = raycast.ray_grid(camera)
    for index, tube in enumerate(scene.fruit):
        v, u = np.nonzero((kind == Kind.FRUIT) & (body == index))
        k, z = part[v, u], depth[v, u]
        points = np.stack([grid.x[v, u] * z, grid.y[v, u] * z, z], axis=1)
        share[v, u] = k / (len(tube.radii_m) - 1)
        normal[v, u] = (points - tube.centres_m[k]) / tube.radii_m[k, None]
    return View(depth, share, normal, kind, body, amodal)


def _hits(scene: Scene, camera: Intrinsics) -> Iterator[tuple[Kind, int, Hit | None]]:
    for index, tube in enumerate(scene.fruit):
        yield Kind.FRUIT, index, raycast.cast_tube(tube, camera)
    for index, leaf in enumerate(scene.leaves):
        yield Kind.LEAF, index, raycast.cast_leaf(leaf, camera)
    for index, stem in enumerate(scene.stems):
        yield Kind.STEM, index, raycast.cast_stem(stem, camera)
    for index, plane in enumerate(scene.planes):
        yield Kind.PLANE, index, raycast.cast_plane(plane, camera)


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
