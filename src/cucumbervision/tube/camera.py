"""Project, deproject and align: the pinhole camera with its lens, on arrays of points."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

_LARGEST_FOOTPRINT = 4096.0  # colour pixels of one depth pixel; of a D4xx it is under 100
_UNDISTORT_STEPS = 10  # as the SDK: more changes nothing at the distortions of a D4xx


class Distortion(StrEnum):
    """Lens models of the RealSense SDK that occur on D4xx colour and aligned streams."""

    NONE = "none"
    BROWN_CONRADY = "brown_conrady"
    MODIFIED_BROWN_CONRADY = "modified_brown_conrady"
    INVERSE_BROWN_CONRADY = "inverse_brown_conrady"


if TYPE_CHECKING:
    Lens = tuple[Distortion, Sequence[float]]


def _brown(
    x: NDArray[Any], y: NDArray[Any], c: Sequence[float], *, scaled_tangential: bool = False
) -> tuple[NDArray[Any], NDArray[Any]]:
    k1, k2, p1, p2, k3 = c
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xr, yr = x * radial, y * radial
    xt, yt = (xr, yr) if scaled_tangential else (x, y)
    return (
        xr + 2 * p1 * xt * yt + p2 * (r2 + 2 * xt * xt),
        yr + 2 * p2 * xt * yt + p1 * (r2 + 2 * yt * yt),
    )


def distort(
    x: NDArray[Any], y: NDArray[Any], model: Distortion, coefficients: Sequence[float]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Apply the lens distortion to the ray (x, y): the forward model, used to project.

    Parameters
    ----------
    x, y : ndarray
        Normalised image coordinates (x/z, y/z).
    model : Distortion
        The lens model.
    coefficients : sequence of float
        k1, k2, p1, p2, k3.

    Returns
    -------
    x, y : ndarray
        Distorted normalised image coordinates, the shape of the input.

    Examples
    --------
    >>> c = (0.1, 0, 0, 0, 0)
    >>> x, y = distort(np.array([0.5]), np.array([0.0]), Distortion.BROWN_CONRADY, c)
    >>> x.round(4)
    array([0.5125])
    """
    if model is Distortion.NONE:
        return x, y
    return _brown(x, y, coefficients, scaled_tangential=model is not Distortion.BROWN_CONRADY)


def undistort(
    x: NDArray[Any], y: NDArray[Any], model: Distortion, coefficients: Sequence[float]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Remove the lens distortion at (x, y): the inverse of `distort`, by fixed point.

    Parameters
    ----------
    x, y : ndarray
        Distorted normalised image coordinates.
    model : Distortion
        The lens model.
    coefficients : sequence of float
        k1, k2, p1, p2, k3.

    Returns
    -------
    x, y : ndarray
        Normalised image coordinates (x/z, y/z), the shape of the input.

    Examples
    --------
    >>> c = (0.1, -0.05, 0.001, -0.002, 0.01)
    >>> ray = np.array([0.3]), np.array([-0.2])
    >>> distorted = distort(*ray, Distortion.BROWN_CONRADY, c)
    >>> [float(x[0].round(6)) for x in undistort(*distorted, Distortion.BROWN_CONRADY, c)]
    [0.3, -0.2]
    """
    if model is Distortion.NONE:
        return x, y
    ux, uy = x, y
    for _ in range(_UNDISTORT_STEPS):
        dx, dy = distort(ux, uy, model, coefficients)
        ux, uy = ux + (x - dx), uy + (y - dy)
    return ux, uy


def scale_error(f_right_px: float, f_wrong_px: float) -> float:
    """Return the relative error of a length across the view, deprojected with a wrong focal length.

    A length's pixels are divided by the focal length, so L'/L - 1 = f_right / f_wrong - 1.

    Examples
    --------
    >>> round(scale_error(910.0, 640.0), 3)
    0.422
    """
    return f_right_px / f_wrong_px - 1.0


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
    """Align depth to the colour camera's pixels.

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

    Raises
    ------
    ValueError
        If a depth pixel covers thousands of colour pixels: no two cameras are like that.

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
    sources = color_sources(
        depth_m,
        depth_matrix,
        color_matrix,
        color_size,
        rotation,
        translation_m,
        depth_lens=depth_lens,
        color_lens=color_lens,
    )
    return np.where(sources >= 0, depth_m.ravel()[sources], np.float32(0))


def color_sources(
    depth_m: NDArray[np.float32],
    depth_matrix: ArrayLike,
    color_matrix: ArrayLike,
    color_size: tuple[int, int],
    rotation: ArrayLike,
    translation_m: ArrayLike,
    *,
    depth_lens: Lens = _NO_LENS,
    color_lens: Lens = _NO_LENS,
) -> NDArray[np.int64]:
    """Return the depth pixel that each colour pixel takes its reading from.

    Parameters
    ----------
    depth_m, depth_matrix, color_matrix, color_size, rotation, translation_m, depth_lens, color_lens
        As for `align_depth_to_color`.

    Returns
    -------
    ndarray of int64, shape (color height, color width)
        Index into `depth_m.ravel()`; -1 where no depth pixel falls.

    Raises
    ------
    ValueError
        As `align_depth_to_color`.
    """
    width, height = color_size
    readings = np.flatnonzero(depth_m > 0)
    # From far to near: of several readings of a colour pixel, the last is the nearest.
    readings = readings[np.argsort(-depth_m.ravel()[readings], kind="stable")]
    v, u = np.divmod(readings, depth_m.shape[1])
    z = depth_m.ravel()[readings]
    kd, kc = np.asarray(depth_matrix, float), np.asarray(color_matrix, float)

    def corner(off_px: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        on_sensor = (u + off_px - kd[0, 2]) / kd[0, 0], (v + off_px - kd[1, 2]) / kd[1, 1]
        x, y = undistort(*on_sensor, *depth_lens)
        points = np.stack([x * z, y * z, z.astype(float)])
        moved = np.asarray(rotation, float) @ points + np.reshape(translation_m, (3, 1))
        # What lies behind the colour camera has no pixel there.
        ahead = np.where(moved[2] > 0, moved[2], np.nan)
        x, y = distort(moved[0] / ahead, moved[1] / ahead, *color_lens)
        pixels = np.stack([x * kc[0, 0] + kc[0, 2], y * kc[1, 1] + kc[1, 2]]) + 0.5
        # The pixel that holds the point, by the cast that the SDK makes: towards zero.
        px, py = np.nan_to_num(np.trunc(pixels), nan=-9.0).astype(np.int64)
        return px, py

    (x0, y0), (x1, y1) = corner(-0.5), corner(0.5)
    footprint = [max(float((b - a).max(initial=0)), 0) + 1 for a, b in ((x0, x1), (y0, y1))]
    if math.prod(footprint) > _LARGEST_FOOTPRINT:
        raise ValueError("a depth pixel covers thousands of colour pixels")
    rank, order = np.full(height * width, -1), np.arange(len(readings))
    for dy in range(int((y1 - y0).max(initial=-1)) + 1):
        for dx in range(int((x1 - x0).max(initial=-1)) + 1):
            x, y = x0 + dx, y0 + dy
            part = (x <= x1) & (y <= y1) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
            nearest = np.full(height * width, -1)
            nearest[y[part] * width + x[part]] = order[part]
            np.maximum(rank, nearest, out=rank)
    sources: NDArray[np.int64] = np.append(readings, -1)[rank]
    return sources.reshape(height, width)
