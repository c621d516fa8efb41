"""One fruit's capture as a picture with layers, for the page to switch; a ruler on it."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.measurement.m1 import window_depths
from cucumbervision.perception.masks import decode_rle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision.dashboard.units import Units
    from cucumbervision.store.records import FruitRecord, MethodRecord

__all__ = [
    "METHOD_COLORS",
    "as_data_url",
    "crop",
    "depth_picture",
    "fruit_layers",
    "mask_outline",
    "ruler_m",
    "scale_bar",
]

# Okabe and Ito's palette, told apart by colour-blind people too.
METHOD_COLORS = {
    "M1": "#56B4E9",
    "M2": "#CC79A7",
    "M3": "#E69F00",
    "M4": "#F0E442",
    "M5": "#0072B2",
    "M6": "#FFFFFF",
}
MASK_COLOR, KEYPOINT_COLOR, BOX_COLOR = "#009E73", "#D55E00", "#F0E442"
QUALITY = 85
RULER_PX = 7
BAR_M = {"cm": 0.10, "in": 0.1016}


def as_data_url(picture: NDArray[np.uint8], widest_px: int = 1280) -> str:
    """Give a picture as a JPEG in a data URL, at most so wide.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        RGB.

    Examples
    --------
    >>> as_data_url(np.zeros((4, 4, 3), np.uint8))[:23]
    'data:image/jpeg;base64,'
    """
    if picture.shape[1] > widest_px:
        height = round(picture.shape[0] * widest_px / picture.shape[1])
        picture = cast(
            "NDArray[np.uint8]",
            cv2.resize(picture, (widest_px, height), interpolation=cv2.INTER_AREA),
        )
    _, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    )
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"


def depth_picture(depth_m: NDArray[np.float32]) -> tuple[NDArray[np.uint8], str]:
    """Colour depth: near is red, far blue, black no reading; and say the range in words.

    Returns
    -------
    picture : ndarray of uint8, shape (H, W, 3)
        RGB.
    words : str
        What the ends of the colours mean.

    Examples
    --------
    >>> depth_picture(np.array([[0.0, 0.5, 1.0]], np.float32))[1]
    'red 50 cm, blue 100 cm, black no reading'
    """
    valid = valid_depth(depth_m)
    if not valid.any():
        return np.zeros((*depth_m.shape, 3), np.uint8), "no reading at all"
    low, high = np.percentile(depth_m[valid], [1, 99])
    share = np.clip((high - depth_m) / max(high - low, 1e-3), 0, 1)
    colored = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    picture = np.ascontiguousarray(colored[..., ::-1])
    picture[~valid] = 0
    return cast("NDArray[np.uint8]", picture), (
        f"red {100 * low:.0f} cm, blue {100 * high:.0f} cm, black no reading"
    )


def fruit_layers(record: FruitRecord, camera: Intrinsics) -> list[dict[str, Any]]:
    """Give what was found and measured of a fruit as layers of lines, in pixels.

    Returns
    -------
    list of dict
        'name', 'color', 'on' (shown at first) and 'shapes': each 'kind' ('area', 'line' or
        'dot') and 'points' (x and y after each other).
    """
    layers = []
    if record.mask is not None:
        mask = decode_rle(record.mask, camera.height, camera.width)
        shapes = [{"kind": "area", "points": line} for line in mask_outline(mask)]
        layers.append({"name": "Mask", "color": MASK_COLOR, "on": True, "shapes": shapes})
    box = (record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px)
    x1, y1, x2, y2 = (round(edge, 1) for edge in box)
    corners = [x1, y1, x2, y1, x2, y2, x1, y2, x1, y1]
    outline = [{"kind": "line", "points": corners}]
    layers.append({"name": "Box", "color": BOX_COLOR, "on": record.mask is None, "shapes": outline})
    if record.keypoints:
        dots = [
            {"kind": "dot", "points": [round(u, 1), round(v, 1)]}
            for u, v, seen in record.keypoints
            if seen > 0.25
        ]
        layers.append({"name": "Keypoints", "color": KEYPOINT_COLOR, "on": False, "shapes": dots})
    for method in record.methods:
        if shapes := _path_shapes(method, camera):
            name = f"{method.method} axis" if method.diameter_m else method.method
            layers.append(
                {
                    "name": name,
                    "color": METHOD_COLORS[method.method],
                    "on": method.method == record.method,
                    "shapes": shapes,
                }
            )
    return layers


def mask_outline(mask: NDArray[np.bool_]) -> list[list[float]]:
    """Give a mask's outlines as polygons: x and y after each other, pixels.

    Examples
    --------
    >>> mask = np.zeros((6, 6), bool)
    >>> mask[1:5, 1:4] = True
    >>> mask_outline(mask)
    [[1, 1, 1, 4, 3, 4, 3, 1]]
    """
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [
        cv2.approxPolyDP(line, 0.7, closed=True).reshape(-1).tolist()
        for line in found
        if len(line) > 2
    ]


def scale_bar(camera: Intrinsics, distance_m: float | None, units: Units) -> dict[str, Any] | None:
    """Give a bar's length in pixels at a distance, and its label.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision.dashboard.units import Units
    >>> scale_bar(Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0), 0.5, Units("cm"))
    {'px': 120.0, 'label': '10 cm at 50 cm distance'}
    """
    if not distance_m:
        return None
    length_m = BAR_M[units.name]
    at = units.value(distance_m)
    label = f"{units.value(length_m):g} {units.name} at {at:.0f} {units.name} distance"
    return {"px": round(length_m * camera.fx_px / distance_m, 1), "label": label}


def ruler_m(capture: Capture, a_px: tuple[float, float], b_px: tuple[float, float]) -> float | None:
    """Measure straight from one point of the picture to another, metres.

    Each point's depth is the median of the readings in a window of 7x7; None where one has none.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> wall = Capture(np.zeros((480, 640, 3), np.uint8), depth, camera, "a")
    >>> round(ruler_m(wall, (220, 240), (420, 240)), 4)
    0.2
    """
    ends = np.array([a_px, b_px], np.float64)
    z = window_depths(capture.depth_m, ends[:, 0], ends[:, 1], RULER_PX, None)
    if not np.isfinite(z).all():
        return None
    x, y = capture.intrinsics.rays(ends[:, 0], ends[:, 1])
    points = np.stack([x * z, y * z, z], axis=1)
    return float(np.linalg.norm(points[1] - points[0]))


def crop(
    thumbnail: NDArray[np.uint8], record: FruitRecord, width_px: int, side_px: int = 96
) -> NDArray[np.uint8]:
    """Cut a fruit out of its capture's thumbnail, as a square.

    Parameters
    ----------
    thumbnail : ndarray of uint8, shape (h, w, 3)
        The small picture.
    width_px : int
        Width of the capture itself.
    side_px : int
        Side of the square.

    Examples
    --------
    >>> from cucumbervision.store.records import FruitRecord
    >>> small = np.zeros((60, 80, 3), np.uint8)
    >>> box = FruitRecord(1, box_x1_px=10, box_y1_px=10, box_x2_px=20, box_y2_px=40)
    >>> crop(small, box, 160).shape
    (96, 96, 3)
    """
    scale = thumbnail.shape[1] / max(width_px, 1)
    x1, y1 = record.box_x1_px * scale, record.box_y1_px * scale
    x2, y2 = record.box_x2_px * scale, record.box_y2_px * scale
    half = max(x2 - x1, y2 - y1, 8.0) * 0.58
    left, top = round((x1 + x2) / 2 - half), round((y1 + y2) / 2 - half)
    side = max(round(2 * half), 8)
    reach = side + max(thumbnail.shape[:2])
    padded = cv2.copyMakeBorder(thumbnail, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    left, top = np.clip([left + reach, top + reach], 0, 2 * reach).tolist()
    cut = padded[top : top + side, left : left + side]
    small = cv2.resize(cut, (side_px, side_px), interpolation=cv2.INTER_AREA)
    return cast("NDArray[np.uint8]", small)


def _path_shapes(method: MethodRecord, camera: Intrinsics) -> list[dict[str, Any]]:
    path = np.array(method.path_m, np.float64).reshape(-1, 3)
    if len(path) < 2 or (path[:, 2] <= 0).any():
        return []
    pixels = np.round(camera.project(path), 1)
    line = {"kind": "line", "points": pixels.reshape(-1).tolist()}
    tips = [{"kind": "dot", "points": pixels[k].tolist()} for k in (0, -1)]
    return [line, *tips]
