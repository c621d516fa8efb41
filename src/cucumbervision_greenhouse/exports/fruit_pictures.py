"""Draw a fruit cropped from its capture with outline, measured line and scale bar."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.run.overlay import (
    COLORS,
    as_jpeg,
    draw_bar,
    draw_line,
    draw_polyline,
    draw_text,
    mask_outlines,
    path_px,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from cucumbervision_greenhouse.store.records import CaptureRecord, FruitRow
    from cucumbervision_greenhouse.store.repository import Store

_LONG_SIDE_PX = 480
_MARGIN, _NARROWEST = 0.12, 0.6  # margin and minimum width, relative to the longer side
_BARS_M = (0.10, 0.05, 0.02, 0.01)
_QUALITY = 90


def fruit_pictures(
    store: Store, round_key: str, table: Sequence[FruitRow]
) -> dict[str, Callable[[], bytes]]:
    """Return functions that draw each fruit of a round's table as JPEG, by key.

    Fruit whose capture was not kept are left out.
    """
    shapes = {view.key: view.shape for view in store.detections(round_key, shapes=True)}
    captures = {
        (stop.key, capture.name): capture
        for stop in store.stops(round_key)
        for capture in stop.captures
    }
    makers: dict[str, Callable[[], bytes]] = {}
    read = lru_cache(4)(store.images.read_color)
    for fruit in table:
        capture = captures[fruit.stop_key, fruit.capture]
        image = capture.color or capture.thumbnail
        if image is not None and store.images.path(image).is_file():
            whole = fruit.with_(**shapes[fruit.key])
            makers[fruit.key] = partial(_jpeg, read, image, whole, capture)
    return makers


def _jpeg(
    read: Callable[[str], NDArray[np.uint8]], image: str, fruit: FruitRow, capture: CaptureRecord
) -> bytes:
    return as_jpeg(draw_fruit(read(image), fruit, capture), quality=_QUALITY)


def draw_fruit(
    color: NDArray[np.uint8], record: FruitRow, capture: CaptureRecord
) -> NDArray[np.uint8]:
    """Draw one fruit, cropped with a margin.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB picture of the capture, possibly downscaled.
    record : FruitRow
        The fruit; a missing mask or method is not drawn.
    capture : CaptureRecord
        Size and camera of the capture.

    Returns
    -------
    ndarray of uint8, shape (h, w, 3)
        RGB, the longer side `_LONG_SIDE_PX`.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import CaptureRecord, FruitRow
    >>> fruit = FruitRow(1, box_x1_px=100, box_y1_px=10, box_x2_px=140, box_y2_px=110)
    >>> capture = CaptureRecord("a", width_px=640, height_px=480)
    >>> draw_fruit(np.zeros((480, 640, 3), np.uint8), fruit, capture).shape
    (480, 330, 3)
    """
    height, width = capture.height_px or color.shape[0], capture.width_px or color.shape[1]
    x_min, y_min, x_max, y_max = _window(record, width, height)
    per_px = np.array([color.shape[1] / width, color.shape[0] / height])
    (x1, y1), (x2, y2) = (
        np.rint(per_px * corner).astype(int) for corner in ((x_min, y_min), (x_max, y_max))
    )
    cut = color[y1 : max(y2, y1 + 1), x1 : max(x2, x1 + 1)]
    zoom = _LONG_SIDE_PX / max(x_max - x_min, y_max - y_min)
    size = round(zoom * (x_max - x_min)), round(zoom * (y_max - y_min))
    by = cv2.INTER_AREA if zoom < per_px[0] else cv2.INTER_CUBIC
    picture = cast("NDArray[np.uint8]", cv2.resize(cut, size, interpolation=by))

    def place(points_px: NDArray[Any]) -> NDArray[np.float64]:
        # Pixel centres are integers, so the window starts half a pixel before the first one.
        return (points_px - (x_min, y_min) + 0.5) * zoom - 0.5

    if record.mask is not None:
        for outline in mask_outlines(decode_rle(record.mask, height, width)):
            draw_polyline(picture, place(outline), COLORS[0], 2, closed=True)
    if capture.camera:
        camera = CameraModel.model_validate(capture.camera).intrinsics
        path = path_px(record.path_m, camera)
        if path is not None:
            draw_line(picture, place(path), COLORS[0], 0.75)
        if record.distance_m:
            _draw_scale(picture, zoom * camera.fx_px / record.distance_m)
    if record.length_m is not None:
        prefix = "at least " if record.at_least else ""
        draw_text(picture, f"{prefix}{100 * record.length_m:.1f} cm", (10, 22), 0.75)
    return picture


def _window(record: FruitRow, width_px: int, height_px: int) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of the crop in whole pixels."""
    x1, y1, x2, y2 = record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px
    if x2 - x1 < 1 or y2 - y1 < 1:  # no box
        return 0, 0, width_px, height_px
    longest = max(x2 - x1, y2 - y1)
    spans = []
    for first_px, last_px, size_px in ((x1, x2, width_px), (y1, y2, height_px)):
        half = max(last_px - first_px, _NARROWEST * longest) / 2 + _MARGIN * longest
        middle = (first_px + last_px) / 2
        first = int(np.clip(round(middle - half), 0, size_px - 1))
        spans.append((first, int(np.clip(round(middle + half), first + 1, size_px))))
    (x_min, x_max), (y_min, y_max) = spans
    return x_min, y_min, x_max, y_max


def _draw_scale(picture: NDArray[np.uint8], px_per_m: float) -> None:
    """Draw the longest scale bar below half of the picture's width."""
    most_m = 0.5 * picture.shape[1] / px_per_m
    length_m = next((bar_m for bar_m in _BARS_M if bar_m <= most_m), _BARS_M[-1])
    draw_bar(picture, length_m * px_per_m, f"{100 * length_m:.0f} cm", 0.75)
