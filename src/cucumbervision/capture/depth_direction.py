"""Direction in which depth is measured: along the optical axis, or along each pixel's ray."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

_PLANE_SAMPLES, _LEAST_PLANE_SAMPLES = 800, 100
_PLANE_ROUNDS = 6
_ON_PLANE = 0.01  # of the distance
# Real boards and tables hold 0.47 to 0.94 of the readings, and 0.11 to 0.18 read the other way;
# pictures between plants hold 0.01 to 0.12 both ways.
_LEAST_PLANE_SHARE, _CLEARLY = 0.4, 2.5


def depth_along_axis(depth_m: NDArray[np.float32], camera: Intrinsics) -> NDArray[np.float32]:
    """Return depth along the optical axis, of distances along each pixel's ray.

    Simulators and laser scanners write the distance to the camera's centre; depth cameras write
    the coordinate z. They differ by the factor sqrt(1 + x^2 + y^2) of the pixel's ray (x, y, 1).

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Distances from the camera's centre, metres; 0 for no reading.
    camera : Intrinsics
        The camera of the depth picture, of size (W, H).

    Returns
    -------
    ndarray of float32, shape (H, W)
        Metres.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> distance_m = np.full((1, 3), 1.25, np.float32)
    >>> depth_along_axis(distance_m, Intrinsics(3, 1, 4.0, 4.0, -2.0, 0.0))[0, 1]
    np.float32(1.0)
    """
    height, width = depth_m.shape
    x, y = camera.rays(np.arange(width)[None, :], np.arange(height)[:, None])
    axial_m: NDArray[np.float32] = (depth_m / np.sqrt(1.0 + x**2 + y**2)).astype(np.float32)
    return axial_m


def is_along_ray(depth_m: NDArray[np.float32], camera: Intrinsics) -> bool:
    """Return whether depth shows a plane only if it is taken for distances along each pixel's ray.

    Most pictures of fruit on a table, a board or before a wall show a plane. Read along the wrong
    direction it is a bowl. Without a plane over much of the picture, as between plants, or in a
    narrow view nothing can be told.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, as for the optical axis; 0 for no reading.
    camera : Intrinsics
        The camera, of size (W, H).

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(64, 48, 45.0, 45.0, 31.5, 23.5)
    >>> x, y = camera.rays(np.arange(64)[None, :], np.arange(48)[:, None])
    >>> wall_m = np.full((48, 64), 0.9, np.float32)
    >>> is_along_ray(wall_m, camera), is_along_ray(wall_m * np.sqrt(1 + x**2 + y**2), camera)
    (False, True)
    """
    height, width = depth_m.shape
    step = max(1, int(np.sqrt(height * width / _PLANE_SAMPLES)))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    samples_m = depth_m[rows, columns]
    x, y = camera.rays(columns, rows)
    is_read = (samples_m > 0) & np.isfinite(samples_m + x + y)
    if np.count_nonzero(is_read) < _LEAST_PLANE_SAMPLES:
        return False
    x, y, axial_m = x[is_read], y[is_read], samples_m[is_read].astype(np.float64)
    terms = np.column_stack([x, y, np.ones(len(x))])
    by_axis = _plane_share(terms, axial_m)
    if by_axis >= _LEAST_PLANE_SHARE:
        return False
    by_ray = _plane_share(terms, axial_m / np.sqrt(1.0 + x**2 + y**2))
    return by_ray >= max(_LEAST_PLANE_SHARE, _CLEARLY * by_axis)


def _plane_share(terms: NDArray[np.float64], depth_m: NDArray[np.float64]) -> float:
    """Return the share of readings on the plane along which most of them lie."""
    # A plane in space is linear in the inverse depth over the picture.
    weight = np.ones(len(depth_m))
    for _ in range(_PLANE_ROUNDS):  # towards the least sum of absolute deviations
        weighted = terms * weight[:, None]
        plane = np.linalg.lstsq(weighted.T @ terms, weighted.T @ (1 / depth_m), rcond=None)[0]
        off = np.abs(1 / depth_m - terms @ plane) * depth_m
        weight = 1 / np.maximum(off, _ON_PLANE / 4)
    return float(np.mean(off < _ON_PLANE))
