"""Square samples of a picture, turned along a fruit: what networks that look closely are shown."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.geometry.pixels import sample_color

if TYPE_CHECKING:
    from numpy.typing import NDArray

PLANES = 6
"""Red, green, blue, depth relative to the fruit, whether depth was read, the fruit's mask."""

_DEPTH_RADII = 4.0  # depth relative to the surface is clipped to this range


def crop_places(
    middle_px: NDArray[np.float64],
    along: NDArray[np.float64],
    step_px: float,
    size_px: tuple[int, int],
) -> NDArray[np.float64]:
    """Return where a turned crop's pixels lie in the picture.

    Parameters
    ----------
    middle_px : ndarray of float64, shape (2,)
        u, v of the crop's middle.
    along : ndarray of float64, shape (2,)
        Unit vector of its rows.
    step_px : float
        Picture pixels of a crop pixel.
    size_px : tuple of int
        Its height and width.

    Returns
    -------
    ndarray of float64, shape (height, width, 2)
        u, v; each of the two is contiguous.

    Examples
    --------
    >>> crop_places(np.array([5.0, 4.0]), np.array([0.0, 1.0]), 2.0, (1, 3)).tolist()
    [[[5.0, 2.0], [5.0, 4.0], [5.0, 6.0]]]
    """
    height, width = size_px
    aside = np.array([-along[1], along[0]])
    columns = (np.arange(width) - (width - 1) / 2) * step_px
    rows = (np.arange(height) - (height - 1) / 2) * step_px
    middle_px, along, aside = (vector[:, None, None] for vector in (middle_px, along, aside))
    return np.moveaxis(middle_px + columns * along + rows[:, None] * aside, 0, -1)


def crop_planes(
    color_rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32] | None,
    mask: NDArray[np.bool_],
    places_px: NDArray[np.float64],
    step_px: float,
    surface_m: float = 0.0,
    radius_m: float = 1.0,
) -> NDArray[np.uint8]:
    """Sample a picture with depth and a mask.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    places_px : ndarray of float64, shape (h, w, 2)
        As `crop_places` returns them; nothing is read outside the picture.
    step_px : float
        Their spacing.
    surface_m, radius_m : float
        Distance of the fruit's surface, and its radius: the origin and the unit of its depth.

    Returns
    -------
    ndarray of uint8, shape (h, w, 6)
        See `PLANES`.
    """
    planes = np.zeros((*places_px.shape[:2], PLANES), np.uint8)
    planes[..., :3] = sample_color(color_rgb, places_px, step_px)
    columns, rows = np.moveaxis(np.rint(places_px).astype(np.intp), -1, 0)
    height, width = mask.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    pixels = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    planes[..., 3] = 128
    planes[..., 5] = np.where(inside & mask[pixels], 255, 0)
    if depth_m is not None:
        z = np.where(inside, depth_m[pixels], np.float32(0))
        read = valid_depth(z)
        off = np.clip((z - surface_m) / radius_m, -_DEPTH_RADII, _DEPTH_RADII)
        planes[..., 3] = np.where(read, np.rint(127.5 + 127.5 * off / _DEPTH_RADII), 128)
        planes[..., 4] = np.where(read, 255, 0)
    return planes
