"""Draw detections onto a plain picture: masks, boxes, scores, and which end is which."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.measurement.m4 import MIN_VISIBILITY
from cucumbervision.pipeline.overlay import COLORS, draw_label, tint_mask

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.perception.instances import Instance

__all__ = ["draw_detections"]

_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)


def draw_detections(
    color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
) -> NDArray[np.uint8]:
    """Draw each fruit's mask, box, score and keypoints.

    The stem end is a square, the blossom end a circle; what is hardly seen is hollow.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture, which is not changed.
    instances : sequence of Instance
        Its fruit.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB.

    Examples
    --------
    >>> from cucumbervision.perception.instances import Instance
    >>> picture = np.zeros((60, 80, 3), np.uint8)
    >>> drawn = draw_detections(picture, [Instance(np.array([9.5, 19.5, 49.5, 39.5]))])
    >>> picture.any(), drawn[20:40, 10].any()
    (np.False_, np.True_)
    """
    picture = color_rgb.copy()
    size = max(max(picture.shape[:2]) / 1280, 0.5)
    for number, one in enumerate(instances):
        color = COLORS[number % len(COLORS)]
        mask = one.detector_mask if one.mask is None else one.mask
        if mask is not None:
            tint_mask(picture, mask, color, size)
        x1, y1, x2, y2 = (round(float(edge)) for edge in one.box)
        cv2.rectangle(picture, (x1, y1), (x2, y2), color, max(1, round(1.5 * size)), cv2.LINE_AA)
        if one.keypoints is not None:
            _draw_keypoints(picture, one.keypoints, color, size)
    for one in instances:
        draw_label(picture, f"{one.class_name} {one.confidence:.2f}", one.box, size)
    return picture


def _draw_keypoints(
    picture: NDArray[np.uint8],
    keypoints: NDArray[np.float64],
    color: tuple[int, int, int],
    size: float,
) -> None:
    points = np.rint(keypoints[:, :2]).astype(np.int32)
    cv2.polylines(picture, [points], False, _BLACK, max(2, round(3 * size)), cv2.LINE_AA)
    cv2.polylines(picture, [points], False, _WHITE, max(1, round(1.5 * size)), cv2.LINE_AA)
    seen = keypoints[:, 2] >= MIN_VISIBILITY
    last = len(points) - 1
    for k, ((u, v), visible) in enumerate(zip(points.tolist(), seen.tolist(), strict=True)):
        radius = max(3, round((7 if k in (0, last) else 4) * size))
        for reach, shade in ((radius, _BLACK), (radius - max(1, round(2 * size)), color)):
            width = -1 if visible or shade == _BLACK else max(1, round(size))
            if k == last:
                corners = (u - reach, v - reach), (u + reach, v + reach)
                cv2.rectangle(picture, *corners, shade, width, cv2.LINE_AA)
            else:
                cv2.circle(picture, (u, v), reach, shade, width, cv2.LINE_AA)
