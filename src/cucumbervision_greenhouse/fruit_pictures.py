"""One fruit drawn: its capture with switchable layers and a ruler."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from cucumbervision.arrays import Array32, Mask, Pixels
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.methods.paper_methods import window_depths
from cucumbervision.methods.table import method_color
from cucumbervision.run.overlay import as_jpeg, mask_outlines, path_px
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import CaptureRecord, FruitRow
from cucumbervision_greenhouse.words import label_words, length_words

CLASS_GREENS = ("#1B7837", "#5AAE61", "#A6DBA0")
"""Colours of a class, the best darkest."""

OTHER_COLORS = {
    "no class": "#E69F00",
    "too short": "#56B4E9",
    "too long": "#D55E00",
    "undecided": "#999999",
    "not measured": "#767676",
}
"""Colours of what has no class."""

PICTURE_FILES = Path(__file__).with_name("static")
"""Folder of the element that shows an image on the capture page and the dashboard."""
_JOINT_COLOR, _JOINT_RGB = "#FF4FD8", (255, 79, 216)
_OUTLINE_STEPS = 8  # of a tube's outline between two points of its path
_MASK_COLOR, _KEYPOINT_COLOR, _BOX_COLOR = "#009E73", "#D55E00", "#F0E442"
_THUMBNAIL_PX = 96
_RULER_PX = 7
_BAR_M = {"cm": 0.10, "in": 0.1016}


def as_data_url(picture: Pixels, widest_px: int = 1280) -> str:
    """Return an image as a JPEG in a data URL, as `as_jpeg` makes it.

    Examples
    --------
    >>> as_data_url(np.zeros((4, 4, 3), np.uint8))[:23]
    'data:image/jpeg;base64,'
    """
    return f"data:image/jpeg;base64,{base64.b64encode(as_jpeg(picture, widest_px)).decode()}"


def depth_picture(depth_m: Array32, units: Units) -> tuple[Pixels, str]:
    """Return depth in colours (near red, far blue, no reading black), and the range in words.

    Returns
    -------
    image : ndarray of uint8, shape (H, W, 3)
        RGB.
    words : str
        The range of the colours.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> depth_picture(np.array([[0.0, 0.5, 1.0]], np.float32), Units("cm"))[1]
    'red 50 cm, blue 100 cm, black no reading'
    """
    valid = valid_depth(depth_m)
    if not valid.any():
        return np.zeros((*depth_m.shape, 3), np.uint8), _("no reading at all")
    nearest_m, farthest_m = np.percentile(depth_m[valid], [1, 99])
    share = np.clip((farthest_m - depth_m) / max(farthest_m - nearest_m, 1e-3), 0, 1)
    colored = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    picture = np.ascontiguousarray(colored[..., ::-1])
    picture[~valid] = 0
    nearest_words, farthest_words = (
        f"{units.value(float(x)):.0f} {units.name}" for x in (nearest_m, farthest_m)
    )
    words = _("red {nearest}, blue {farthest}, black no reading").format(
        nearest=nearest_words, farthest=farthest_words
    )
    return cast("Pixels", picture), words


def fruit_layers(record: FruitRow, camera: Intrinsics) -> list[dict[str, Any]]:
    """Return what was found and measured of a fruit as layers of lines, in pixels.

    Parameters
    ----------
    record : FruitRow
        The fruit in its capture.
    camera : Intrinsics
        Of that capture.

    Returns
    -------
    list of dict
        'name', 'color', 'on' (shown at first), 'detail' (offered behind 'Details') and 'shapes':
        each 'kind' ('area', 'line' or 'dot') and 'points' (x and y after each other).
    """

    def layer(name: str, color: str, on: bool, shapes: list[dict[str, Any]]) -> dict[str, Any]:
        detail = name != _("Outline")
        return {"name": name, "color": color, "on": on, "detail": detail, "shapes": shapes}

    layers = []
    if record.mask is not None:
        mask = decode_rle(record.mask, camera.height, camera.width)
        areas = [{"kind": "area", "points": line} for line in mask_outline(mask)]
        layers.append(layer(_("Outline"), _MASK_COLOR, True, areas))
    layers.append(layer(_("Box"), _BOX_COLOR, record.mask is None, [_box_line(record)]))
    if record.keypoints:
        visible = [(u, v) for u, v, confidence in record.keypoints if confidence > 0.25]
        dots = [{"kind": "dot", "points": [round(u, 1), round(v, 1)]} for u, v in visible]
        layers.append(layer(_("Keypoints"), _KEYPOINT_COLOR, False, dots))
    if shapes := _path_shapes(record, camera):
        name = record.method
        if record.diameter_m:
            name = _("{method} axis").format(method=name)
        layers.append(layer(name, method_color(record.method), True, shapes))
    return layers


def stop_layers(
    capture: CaptureRecord, fruit: Sequence[FruitRow], grades: Mapping[str, str], units: Units
) -> list[dict[str, Any]]:
    """Return all fruit of a capture as layers, one a class, each fruit with its length.

    Parameters
    ----------
    capture : CaptureRecord
        The capture.
    fruit : sequence of FruitRow
        Its fruit with their masks, as `Store.detections` returns them with `shapes`.
    grades : mapping of str to str
        Names of their classes, by the fruit's keys.
    """
    layers: dict[str, dict[str, Any]] = {}
    for view in fruit:
        name = grades[view.key]
        color = class_color(name)
        shapes = layers.setdefault(
            name, {"name": label_words(name), "color": color, "on": True, "shapes": []}
        )
        if view.mask is None:
            lines = [_box_line(view)]
        else:
            mask = decode_rle(view.mask, capture.height_px, capture.width_px)
            lines = [{"kind": "area", "points": line} for line in mask_outline(mask)]
        centre_px = [(view.box_x1_px + view.box_x2_px) / 2, (view.box_y1_px + view.box_y2_px) / 2]
        text = length_words(view, units)
        shapes["shapes"] += [*lines, {"kind": "label", "points": centre_px, "text": text}]
    return list(layers.values())


def _box_line(record: FruitRow) -> dict[str, Any]:
    edges = (record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px)
    x1, y1, x2, y2 = (round(edge, 1) for edge in edges)
    return {"kind": "line", "points": [x1, y1, x2, y1, x2, y2, x1, y2, x1, y1]}


def _path_shapes(record: FruitRow, camera: Intrinsics) -> list[dict[str, Any]]:
    points = path_px(record.path_m, camera)
    if points is None:
        return []
    pixels = np.round(points, 1)
    line = {"kind": "line", "points": pixels.reshape(-1).tolist()}
    return [line, *({"kind": "dot", "points": pixels[k].tolist()} for k in (0, -1))]


def mask_outline(mask: Mask) -> list[list[float]]:
    """Return a mask's outlines as polygons: x and y after each other, pixels.

    Examples
    --------
    >>> mask = np.zeros((6, 6), bool)
    >>> mask[1:5, 1:4] = True
    >>> mask_outline(mask)
    [[1, 1, 1, 4, 3, 4, 3, 1]]
    """
    outlines = (cv2.approxPolyDP(line, 0.7, closed=True) for line in mask_outlines(mask))
    return [line.reshape(-1).tolist() for line in outlines if len(line) > 2]


def scale_bar(camera: Intrinsics, distance_m: float | None, units: Units) -> dict[str, Any] | None:
    """Return a scale bar's length in pixels at a distance, and its label.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_greenhouse.settings import Units
    >>> scale_bar(Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0), 0.5, Units("cm"))
    {'px': 120.0, 'label': '10 cm at 50 cm distance'}
    """
    if not distance_m:
        return None
    length_m = _BAR_M[units.name]
    distance = units.value(distance_m)
    label = _("{length} at {distance} distance").format(
        length=f"{units.value(length_m):g} {units.name}", distance=f"{distance:.0f} {units.name}"
    )
    return {"px": round(length_m * camera.fx_px / distance_m, 1), "label": label}


def ruler_m(capture: Capture, a_px: tuple[float, float], b_px: tuple[float, float]) -> float | None:
    """Compute the straight distance between two points of the image, metres.

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
    z = window_depths(capture.depth_m, ends[:, 0], ends[:, 1], _RULER_PX, None)
    if not np.isfinite(z).all():
        return None
    x, y = capture.intrinsics.rays(ends[:, 0], ends[:, 1])
    points = np.stack([x * z, y * z, z], axis=1)
    return float(np.linalg.norm(points[1] - points[0]))


def crop(
    thumbnail: Pixels,
    record: FruitRow,
    width_px: int,
    side_px: int = _THUMBNAIL_PX,
    half_share: float = 0.58,
) -> Pixels:
    """Return a fruit cut out of its capture's image, as a square.

    Parameters
    ----------
    thumbnail : ndarray of uint8, shape (h, w, 3)
        The capture's image, or a smaller one of it.
    width_px : int
        Width of the capture itself.
    side_px : int
        Of the square.
    half_share : float
        Half of the square's side, as a share of the fruit's box: 0.5 and more.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> small = np.zeros((60, 80, 3), np.uint8)
    >>> box = FruitRow(1, box_x1_px=10, box_y1_px=10, box_x2_px=20, box_y2_px=40)
    >>> crop(small, box, 160).shape
    (96, 96, 3)
    """
    scale = thumbnail.shape[1] / max(width_px, 1)
    x1, y1 = record.box_x1_px * scale, record.box_y1_px * scale
    x2, y2 = record.box_x2_px * scale, record.box_y2_px * scale
    half = max(x2 - x1, y2 - y1, 8.0) * half_share
    first_x, top = round((x1 + x2) / 2 - half), round((y1 + y2) / 2 - half)
    side = max(round(2 * half), 8)
    reach = side + max(thumbnail.shape[:2])
    padded = cv2.copyMakeBorder(thumbnail, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    first_x, top = np.clip([first_x + reach, top + reach], 0, 2 * reach).tolist()
    cut = padded[top : top + side, first_x : first_x + side]
    small = cv2.resize(cut, (side_px, side_px), interpolation=cv2.INTER_AREA)
    return cast("Pixels", small)


def class_color(name: str) -> str:
    """Return the colour of a class: greens for classes, the best darkest.

    Examples
    --------
    >>> class_color("class I"), class_color("too long")
    ('#1B7837', '#D55E00')
    """
    return OTHER_COLORS.get(name) or CLASS_GREENS[min(name.count("I"), len(CLASS_GREENS)) - 1]
