"""Convert a region of the depth picture to a point cloud, for all methods."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.instances.masks import mask_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

_STRIDE = 2  # pixels, of a box


def masked_points(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], intrinsics: Intrinsics
) -> NDArray[np.float64]:
    """Deproject every pixel of a mask that has a valid reading.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Camera coordinates in metres (x right, y down, z forward; Eq. 4 of the paper), in row-major
        order of the pixels.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth = np.zeros((48, 64), np.float32)
    >>> depth[24, 38] = 0.5
    >>> camera = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> masked_points(depth, np.ones((48, 64), bool), camera).tolist()
    [[0.05, 0.0, 0.5]]
    """
    window = mask_window(mask)
    if window is None:
        return np.empty((0, 3))
    region = depth_m[window]
    v, u = np.nonzero(mask[window] & valid_depth(region))
    return _deproject(u + window[1].start, v + window[0].start, region[v, u], intrinsics)


def box_points(
    depth_m: NDArray[np.float32], box: NDArray[Any], intrinsics: Intrinsics
) -> NDArray[np.float64]:
    """Deproject every second pixel, in both directions, of a box that has a valid reading.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels; parts outside the picture are ignored.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Camera coordinates in metres.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth = np.full((48, 64), 0.5, np.float32)
    >>> camera = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> box_points(depth, np.array([9.5, 9.5, 19.5, 13.5]), camera).shape
    (10, 3)
    """
    x1, y1, x2, y2 = box_pixels(box, depth_m.shape)
    region = depth_m[y1:y2:_STRIDE, x1:x2:_STRIDE]
    v, u = np.nonzero(valid_depth(region))
    return _deproject(u * _STRIDE + x1, v * _STRIDE + y1, region[v, u], intrinsics)


def box_pixels(box: NDArray[Any], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return the half-open range x1, y1, x2, y2 of pixels whose centres lie in a box.

    Parameters
    ----------
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    shape : tuple of int
        (H, W) of the picture; the range is clipped to it.

    Examples
    --------
    >>> box_pixels(np.array([-3.0, 1.5, 4.5, 99.0]), (10, 20))
    (0, 2, 5, 10)
    """
    height, width = shape
    edges = np.concatenate([np.ceil(box[:2]), np.floor(box[2:]) + 1])
    x1, y1, x2, y2 = np.clip(edges, 0, [width, height] * 2).astype(int).tolist()
    return x1, y1, x2, y2


def _deproject(
    u_px: NDArray[Any], v_px: NDArray[Any], z_m: NDArray[Any], intrinsics: Intrinsics
) -> NDArray[np.float64]:
    x, y = intrinsics.rays(u_px, v_px)
    return np.stack([x * z_m, y * z_m, z_m], axis=1)
