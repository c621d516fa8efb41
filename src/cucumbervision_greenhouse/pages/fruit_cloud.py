"""One fruit's points and its fitted tube in 3D."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pydeck

from cucumbervision.capture.frames import valid_depth
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.fruit.masks import mask_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision_greenhouse.store.records import FruitRow

_POINTS = 3500
_RINGS, _RING_POINTS = 16, 20
_MARGIN_PX = 12
_SLAB_M = 0.08  # points farther in front of or behind the fruit are left out
CLOUD_HEIGHT_PX = 420
_MOST_PERCENT = 97
_RING_COLOR, _AXIS_COLOR = (86, 180, 233), (255, 255, 255)
_END_COLOR, _CUT_COLOR = (240, 228, 66), (213, 94, 0)


def point_cloud(capture: Capture, record: FruitRow) -> pydeck.Deck | None:
    """Return a fruit's depth points and the fitted tube as a scene that can be rotated.

    Parameters
    ----------
    capture : Capture
        The frame.
    record : FruitRow
        The fruit, with mask and methods.

    Returns
    -------
    pydeck.Deck or None
        In millimetres about the fruit's middle, y up and z towards the camera: the fruit's points
        in their colours, what is near it paler, rings and axis of the tube, its two ends, the place
        to cut, and a bar of 5 cm. None where the fruit has no mask or no depth.
    """
    pixels = _fruit_pixels(capture, record)
    if pixels is None:
        return None
    points, colors = _sample(capture, pixels[0], _POINTS)
    surroundings, near_colors = _sample(capture, pixels[1], _POINTS // 3)
    middle = np.median(points, axis=0)

    def scene_mm(at_m: NDArray[np.float64]) -> list[list[float]]:
        rounded: list[list[float]] = np.round(1000 * (at_m - middle) * (1, -1, -1), 1).tolist()
        return rounded

    dots = zip(
        [*scene_mm(points), *scene_mm(surroundings)],
        [*colors.tolist(), *(near_colors // 2 + 90).tolist()],
        strict=True,
    )
    lines: list[dict[str, Any]] = [
        {"path": scene_mm(path), "color": color, "width": width}
        for path, color, width in _tube_lines(record)
    ]
    # Readings at the outline that lie far behind would make the fruit small.
    reach_mm = np.percentile(np.abs(np.array(scene_mm(points))), _MOST_PERCENT, axis=0)
    below = -float(reach_mm[1]) - 15
    bar = [[-25.0, below, 0.0], [25.0, below, 0.0]]
    lines.append({"path": bar, "color": _AXIS_COLOR, "width": 2.0})
    marks = [
        {"at": scene_mm(place_m[None])[0], "color": color}
        for place_m, color in _marked_places(record)
    ]
    cloud = [{"at": place, "color": color} for place, color in dots]
    return _scene(cloud, marks, lines, float(reach_mm.max()))


def _fruit_pixels(
    capture: Capture, record: FruitRow
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Return the pixels with a reading on a fruit, and near it at about its depth."""
    if record.mask is None:
        return None
    mask = decode_rle(record.mask, capture.height, capture.width)
    readings = valid_depth(capture.depth_m)
    inside, window = mask & readings, mask_window(mask, _MARGIN_PX)
    if window is None or not inside.any():
        return None
    slab = np.abs(capture.depth_m - np.median(capture.depth_m[inside])) < _SLAB_M
    around = np.zeros_like(mask)
    around[window] = (readings & slab & ~mask)[window]
    return inside, around


def _marked_places(record: FruitRow) -> list[tuple[NDArray[np.float64], tuple[int, int, int]]]:
    """Return the two ends and the place to cut, where they are known, each with its colour."""
    places = []
    for name, color in (("stem", _END_COLOR), ("blossom", _END_COLOR), ("cut", _CUT_COLOR)):
        place = [getattr(record, f"{name}_{axis}_m") for axis in "xyz"]
        if None not in place:
            places.append((np.array(place, np.float64), color))
    return places


def _scene(
    dots: list[dict[str, Any]],
    marks: list[dict[str, Any]],
    lines: list[dict[str, Any]],
    reach_mm: float,
) -> pydeck.Deck:
    layers = [
        *(
            pydeck.Layer(
                "PointCloudLayer",
                places,
                get_position="at",
                get_color="color",
                size_units="'common'",
                point_size=size,
                material=False,
            )
            for places, size in ((dots, 0.6), (marks, 2.5))
        ),
        pydeck.Layer(
            "PathLayer",
            lines,
            get_path="path",
            get_color="color",
            get_width="width",
            width_units="'common'",
            width_min_pixels=1,
            billboard=True,
        ),
    ]
    view = pydeck.View("OrbitView", orbit_axis="Y", controller=True)
    turned = pydeck.ViewState(
        target=[0, 0, 0],
        rotation_x=15,
        rotation_orbit=-30,
        zoom=math.log2(CLOUD_HEIGHT_PX / (2.8 * reach_mm)),
    )
    # No map provider, so that no other machine is contacted.
    return pydeck.Deck(layers, [view], initial_view_state=turned, map_provider=None, map_style=None)


def _tube_lines(record: FruitRow) -> list[tuple[NDArray[np.float64], tuple[int, int, int], float]]:
    """Return rings and axis of the fitted tube, each with its colour and width."""
    if not record.diameter_m:
        return []
    axis = np.array(record.path_m, np.float64)
    rings = _tube_rings(axis, np.array(record.diameter_m, np.float64))
    return [*((ring, _RING_COLOR, 0.5) for ring in rings), (axis, _AXIS_COLOR, 1.5)]


def _tube_rings(
    axis_m: NDArray[np.float64], diameter_m: NDArray[np.float64], rings: int = _RINGS
) -> list[NDArray[np.float64]]:
    """Return circles about an axis, as closed lines of points.

    Parameters
    ----------
    axis_m : ndarray of float64, shape (K, 3)
        The axis, metres.
    diameter_m : ndarray of float64, shape (K,)
        The diameter at each point.

    Returns
    -------
    list of ndarray of float64, shape (_RING_POINTS + 1, 3)

    Examples
    --------
    >>> axis = np.stack([np.linspace(0, 0.2, 9), np.zeros(9), np.full(9, 0.5)], axis=1)
    >>> rings = _tube_rings(axis, np.full(9, 0.04), rings=3)
    >>> len(rings), rings[1].shape, round(float(np.linalg.norm(rings[1][0] - axis[4])), 6)
    (3, (21, 3), 0.02)
    """
    chosen = np.unique(np.linspace(0, len(axis_m) - 1, rings).round().astype(int))
    ahead = np.gradient(axis_m, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    turn = np.linspace(0, 2 * np.pi, _RING_POINTS + 1)[:, None]
    circles = []
    for k in chosen.tolist():
        # Any vector that is not parallel to the axis can start the circle.
        normal = np.cross(ahead[k], np.eye(3)[np.argmin(np.abs(ahead[k]))])
        normal /= np.linalg.norm(normal)
        binormal = np.cross(ahead[k], normal)
        circles.append(
            axis_m[k] + diameter_m[k] / 2 * (np.cos(turn) * normal + np.sin(turn) * binormal)
        )
    return circles


def _sample(
    capture: Capture, where: NDArray[np.bool_], limit: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the 3D points and colours of at most about `limit` pixels."""
    v, u = np.nonzero(where)
    step = max(1, len(v) // limit)
    v, u = v[::step], u[::step]
    z = capture.depth_m[v, u].astype(np.float64)
    x, y = capture.intrinsics.rays(u.astype(np.float64), v.astype(np.float64))
    return np.stack([x * z, y * z, z], axis=1), capture.color[v, u]
