"""Depth as the depth camera sees it, brought into the colour camera's picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.geometry.camera import Distortion, distort, undistort

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    Lens = tuple[Distortion, Sequence[float]]

__all__ = ["align_depth_to_color"]

_NO_LENS = (Distortion.NONE, (0.0, 0.0, 0.0, 0.0, 0.0))


def align_depth_to_color(
    depth_m: NDArray[np.float32],
    depth_matrix: ArrayLike,
    color_matrix: ArrayLike,
    color_size: tuple[int, int],
    rotation: ArrayLike,
    translation_m: ArrayLike,
    *,
    depth_lens: Lens = _NO_LENS,
    color_lens: Lens = _NO_LENS,
) -> NDArray[np.float32]:
    """Give depth in the colour camera's pixels.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres in the depth camera's pixels; 0 where there is no reading.
    depth_matrix, color_matrix : array_like, shape (3, 3)
        The cameras' matrices, pixels.
    color_size : tuple of int
        (width, height) of the colour picture, pixels.
    rotation : array_like, shape (3, 3)
        R of x_color = R x_depth + t, rows first.
    translation_m : array_like, shape (3,)
        t, metres.
    depth_lens, color_lens : tuple of (Distortion, coefficients), optional
        The cameras' lens models.

    Returns
    -------
    ndarray of float32, shape (color height, color width)
        Metres; 0 where no depth pixel falls. The value is the depth camera's own z, as in the
        SDK: on a D4xx the two cameras' z differ by less than 1 mm.

    Notes
    -----
    The rule of the RealSense SDK's `rs2::align` (`align.cpp`, `sse-align.cpp`): a depth pixel's
    footprint runs from the projection of its corner at -0.5, -0.5 px to that of its corner at
    +0.5, +0.5 px; every colour pixel from the one that holds the first to the one that holds the
    second takes the depth; of several depths the nearest stays. One difference: the SDK's fast
    path leaves out the colour camera's lens unless it is `modified_brown_conrady`; here every
    lens model is applied (a D435's colour stream has no distortion).

    Examples
    --------
    >>> depth = np.zeros((3, 3), np.float32)
    >>> depth[1, 1] = 0.5
    >>> k, k_color = [[10, 0, 1], [0, 10, 1], [0, 0, 1]], [[6, 0, 1.3], [0, 6, 1.1], [0, 0, 1]]
    >>> moved = align_depth_to_color(depth, k, k_color, (4, 3), np.eye(3), [0.05, 0, 0])
    >>> np.argwhere(moved > 0).tolist()
    [[1, 2]]
    """
    width, height = color_size
    v, u = np.nonzero(depth_m > 0)
    z = depth_m[v, u]
    project = (depth_matrix, color_matrix, rotation, translation_m, depth_lens, color_lens)
    x0, y0 = _corner(u - 0.5, v - 0.5, z, *project)
    x1, y1 = _corner(u + 0.5, v + 0.5, z, *project)
    aligned = np.full(height * width, np.inf, np.float32)
    for dy in range(int((y1 - y0).max(initial=-1)) + 1):
        for dx in range(int((x1 - x0).max(initial=-1)) + 1):
            x, y = x0 + dx, y0 + dy
            part = (x <= x1) & (y <= y1) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
            np.minimum.at(aligned, y[part] * width + x[part], z[part])
    aligned[np.isinf(aligned)] = 0.0
    return aligned.reshape(height, width)


def _corner(
    u: NDArray[Any],
    v: NDArray[Any],
    z: NDArray[Any],
    depth_matrix: ArrayLike,
    color_matrix: ArrayLike,
    rotation: ArrayLike,
    translation_m: ArrayLike,
    depth_lens: Lens,
    color_lens: Lens,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    kd, kc = np.asarray(depth_matrix, float), np.asarray(color_matrix, float)
    x, y = undistort((u - kd[0, 2]) / kd[0, 0], (v - kd[1, 2]) / kd[1, 1], *depth_lens)
    points = np.stack([x * z, y * z, z.astype(float)])
    moved = np.asarray(rotation, float) @ points + np.reshape(translation_m, (3, 1))
    # What lies behind the colour camera has no pixel there.
    ahead = np.where(moved[2] > 0, moved[2], np.nan)
    x, y = distort(moved[0] / ahead, moved[1] / ahead, *color_lens)
    pixels = np.stack([x * kc[0, 0] + kc[0, 2], y * kc[1, 1] + kc[1, 2]]) + 0.5
    # The pixel that holds the point, by the cast that the SDK makes: towards zero.
    px, py = np.nan_to_num(np.trunc(pixels), nan=-9.0).astype(np.int64)
    return px, py
