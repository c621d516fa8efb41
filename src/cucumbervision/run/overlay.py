"""Draw measured or detected fruit, lines, outlines, scale bars and letters onto a image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cucumbervision.arrays import Array, Mask, Numbers, Pixels
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import encoded
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import mask_window
from cucumbervision.methods.paper_methods import MIN_VISIBILITY
from cucumbervision.methods.result import Fruit

# Okabe and Ito's palette, suitable for colour-blind people (RGB).
COLORS = ((230, 159, 0), (86, 180, 233), (240, 228, 66), (204, 121, 167), (0, 158, 115))

_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)

_TINT = 0.30

_BAR_M = 0.10

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SUBPIXEL_BITS = 4  # of OpenCV's lines


def draw_overlay(capture: Capture, fruit: Sequence[Fruit]) -> Pixels:
    """Draw each fruit's mask, measured line, tips and length, and a scale bar.

    Parameters
    ----------
    capture : Capture
        The frame; its colour image is not changed.
    fruit : sequence of Fruit
        The fruit in it, measured, numbered from 1.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB, the size of the capture.
    """
    image = capture.color.copy()
    size = max(capture.height / 720, 0.5)
    for number, measured in enumerate(fruit, start=1):
        color = COLORS[(number - 1) % len(COLORS)]
        if measured.mask is None:
            x1, y1, x2, y2 = (round(float(x)) for x in measured.instance.box)
            cv2.rectangle(image, (x1, y1), (x2, y2), color, max(1, round(2 * size)), cv2.LINE_AA)
        else:
            _tint_mask(image, measured.mask, color, size)
        path_m = None if measured.selected is None else measured.selected.path_m
        points = path_px(path_m, capture.intrinsics)
        if points is not None:
            _draw_line(image, points, color, size)
    for number, measured in enumerate(fruit, start=1):
        _draw_label(image, _label(number, measured), measured.instance.box, size)
    _draw_scale(image, capture, fruit, size)
    if capture.simulated:
        draw_text(image, "simulated capture", (int(12 * size), int(28 * size)), size)
    return image


def _tint_mask(image: Pixels, inside: Mask, color: tuple[int, int, int], size: float) -> None:
    """Tint a mask's pixels and draw its outline, in place; `size` scales the lines."""
    window = mask_window(inside)
    if window is None:
        return
    part, part_mask = image[window], inside[window]
    part[part_mask] = ((1 - _TINT) * part[part_mask] + _TINT * np.array(color)).astype(np.uint8)
    for outline in mask_outlines(inside):
        draw_polyline(image, outline, color, max(1, round(1.5 * size)), closed=True)


def mask_outlines(mask: Mask) -> list[NDArray[np.int32]]:
    """Return the outer outline of each part of a mask: arrays of shape (N, 2), pixels.

    Examples
    --------
    >>> mask = np.zeros((6, 6), bool)
    >>> mask[1:5, 1:4] = True
    >>> mask_outlines(mask)[0][:4].tolist()
    [[1, 1], [1, 2], [1, 3], [1, 4]]
    """
    window = mask_window(mask)
    if window is None:
        return []
    outlines, _ = cv2.findContours(
        mask[window].astype(np.uint8),
        cv2.RETR_EXTERNAL,
        cv2.CHAIN_APPROX_NONE,
        offset=(window[1].start, window[0].start),
    )
    return [outline.reshape(-1, 2).astype(np.int32) for outline in outlines]


def path_px(path_m: ArrayLike | None, camera: Intrinsics) -> Array | None:
    """Return a measured line in the image, shape (N, 2); None without one before the camera."""
    path = np.array([] if path_m is None else path_m, np.float64).reshape(-1, 3)
    return None if len(path) < 2 or (path[:, 2] <= 0).any() else camera.project(path)


def draw_polyline(
    image: Pixels,
    points_px: Numbers,
    color: tuple[int, int, int],
    width_px: int,
    *,
    closed: bool = False,
) -> None:
    """Draw a smooth line through points of shape (N, 2), in place."""
    points = np.rint(points_px * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.polylines(image, [points], closed, color, width_px, cv2.LINE_AA, _SUBPIXEL_BITS)


def _draw_line(image: Pixels, points_px: Array, color: tuple[int, int, int], size: float) -> None:
    """Draw a line (points of shape (N, 2)) with its tips in a colour, in place."""
    draw_polyline(image, points_px, _BLACK, max(2, round(4 * size)))
    draw_polyline(image, points_px, _WHITE, max(1, round(2 * size)))
    for centre_px in np.rint(points_px[[0, -1]]).astype(int).tolist():
        cv2.circle(image, centre_px, max(3, round(6 * size)), _BLACK, -1, cv2.LINE_AA)
        cv2.circle(image, centre_px, max(2, round(4 * size)), color, -1, cv2.LINE_AA)


def _label(number: int, fruit: Fruit) -> str:
    length = fruit.length
    if length is None:
        return f"{number}: not measured ({fruit.reason})"
    # A fruit that continues out of sight is longer than its visible part.
    bound = "at least " if fruit.at_least else ""
    return f"{number}: {bound}{100 * length.value_m:.1f} cm {length.kind}, {fruit.method}"


def _draw_label(image: Pixels, label: str, box: Array, size: float) -> None:
    """Write a label above a box, or below it if there is no space, in place."""
    (width, height), _ = cv2.getTextSize(label, _FONT, 0.65 * size, max(1, round(2 * size)))
    x = float(np.clip(box[0], 4, max(4, image.shape[1] - width - 8)))
    above = box[1] - 10 * size
    y = above if above > height + 6 else min(box[3] + height + 12 * size, image.shape[0] - 8)
    draw_text(image, label, (int(x), int(y)), size)


def draw_text(image: Pixels, text: str, corner_px: tuple[int, int], size: float) -> None:
    """Write white letters on a darkened plate, their lower left corner at a pixel, in place."""
    scale, thin = 0.65 * size, max(1, round(1.6 * size))
    (width, height), below = cv2.getTextSize(text, _FONT, scale, thin)
    pad = max(3, round(5 * size))
    top, left_px = max(corner_px[1] - height - pad, 0), max(corner_px[0] - pad, 0)
    plate = image[top : corner_px[1] + below + pad, left_px : corner_px[0] + width + pad]
    plate[:] = (0.35 * plate).astype(np.uint8)
    cv2.putText(image, text, corner_px, _FONT, scale, _WHITE, thin, cv2.LINE_AA)


def _draw_scale(image: Pixels, capture: Capture, fruit: Sequence[Fruit], size: float) -> None:
    readings = [capture.depth_m[measured.mask] for measured in fruit if measured.mask is not None]
    depths = [np.median(near) for d in readings if len(near := d[valid_depth(d)])]
    if not depths:
        return
    depth = float(np.median(depths))
    length_px = _BAR_M * capture.intrinsics.fx_px / depth
    left_px, y = round(16 * size), image.shape[0] - round(20 * size)
    right = left_px + round(length_px)
    for color, thick in ((_BLACK, round(8 * size)), (_WHITE, round(4 * size))):
        cv2.line(image, (left_px, y), (right, y), color, max(2, thick), cv2.LINE_AA)
    text = f"{100 * _BAR_M:.0f} cm at {100 * depth:.0f} cm distance"
    draw_text(image, text, (left_px, y - round(14 * size)), size)


def draw_detections(color_rgb: Pixels, instances: Sequence[Instance]) -> Pixels:
    """Draw each fruit's mask, box, score and keypoints.

    The stem end is a square, the blossom end a circle; keypoints of low visibility are hollow.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The image, which is not changed.
    instances : sequence of Instance
        Its fruit.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB.

    Examples
    --------
    >>> from cucumbervision.fruit.instance import Instance
    >>> image = np.zeros((60, 80, 3), np.uint8)
    >>> drawn = draw_detections(image, [Instance(np.array([9.5, 19.5, 49.5, 39.5]))])
    >>> image.any(), drawn[20:40, 10].any()
    (np.False_, np.True_)
    """
    image = color_rgb.copy()
    size = max(max(image.shape[:2]) / 1280, 0.5)
    for number, instance in enumerate(instances):
        color = COLORS[number % len(COLORS)]
        mask = instance.detector_mask if instance.mask is None else instance.mask
        if mask is not None:
            _tint_mask(image, mask, color, size)
        x1, y1, x2, y2 = (round(float(edge)) for edge in instance.box)
        cv2.rectangle(image, (x1, y1), (x2, y2), color, max(1, round(1.5 * size)), cv2.LINE_AA)
        if instance.keypoints is not None:
            _draw_keypoints(image, instance.keypoints, color, size)
    for instance in instances:
        _draw_label(image, f"{instance.class_name} {instance.confidence:.2f}", instance.box, size)
    return image


def _draw_keypoints(
    image: Pixels, keypoints: Array, color: tuple[int, int, int], size: float
) -> None:
    points = np.rint(keypoints[:, :2]).astype(np.int32)
    draw_polyline(image, points, _BLACK, max(2, round(3 * size)))
    draw_polyline(image, points, _WHITE, max(1, round(1.5 * size)))
    is_visible = keypoints[:, 2] >= MIN_VISIBILITY
    last = len(points) - 1
    for k, ((u, v), visible) in enumerate(zip(points.tolist(), is_visible.tolist(), strict=True)):
        radius = max(3, round((7 if k in (0, last) else 4) * size))
        for reach, shade in ((radius, _BLACK), (radius - max(1, round(2 * size)), color)):
            width = -1 if visible or shade == _BLACK else max(1, round(size))
            if k == last:
                corners = (u - reach, v - reach), (u + reach, v + reach)
                cv2.rectangle(image, *corners, shade, width, cv2.LINE_AA)
            else:
                cv2.circle(image, (u, v), reach, shade, width, cv2.LINE_AA)


def as_jpeg(image: Pixels, widest_px: int = 1280, quality: int = 85) -> bytes:
    """Return a image as a JPEG, scaled down to a width where it is wider.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        RGB.
    widest_px : int
        The width.
    quality : int
        Of the JPEG, up to 100.

    Examples
    --------
    >>> as_jpeg(np.zeros((4, 4, 3), np.uint8))[:3].hex()
    'ffd8ff'
    """
    if image.shape[1] > widest_px:
        height = round(image.shape[0] * widest_px / image.shape[1])
        small = cv2.resize(image, (widest_px, height), interpolation=cv2.INTER_AREA)
        image = cast("Pixels", small)
    return encoded(image, ".jpg", quality)
