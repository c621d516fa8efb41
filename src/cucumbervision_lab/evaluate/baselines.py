"""Baseline lengths by skan on the same mask and depth.

skan returns a skeleton path in pixels, whose 3D length is computed by `lifted_length`. The path is
not extended at the ends, although a skeleton may stop up to one radius before the tip.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import MissingExtraError
from cucumbervision.fruit.masks import mask_window
from cucumbervision_lab.arrays import Array, Array32, Mask

if TYPE_CHECKING:
    from types import ModuleType

Baseline = Callable[[Array32, Mask, Intrinsics], float | None]

_HALF_WINDOW_PX = 2  # median of a 5x5 window, as in M4
_SMOOTH_PX = 41  # maximum window of the smoothing along the path
_MIN_PATH_PX = 5


def skan_length(depth_m: Array32, mask: Mask, intrinsics: Intrinsics) -> float | None:
    """Compute the 3D length of a mask's longest shortest skeleton path by skan.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 is no reading.
    mask : ndarray of bool, shape (H, W)
        Mask of the fruit.
    intrinsics : Intrinsics
        Intrinsics of the colour stream.

    Returns
    -------
    float or None
        Length in metres; None without a path.

    Raises
    ------
    MissingExtraError
        If skan or scikit-image is not installed.

    Notes
    -----
    `skimage.morphology.skeletonize`, then `skan.csr.find_main_branches` (Nunez-Iglesias et al.
    2018, PeerJ 6:e4312), which marks the branches of the longest shortest path of each connected
    part; the longest of them is taken.
    """
    skan, morphology = _package("skan"), _package("skimage.morphology", "scikit-image")
    window = mask_window(mask)
    if window is None:
        return None
    thin = morphology.skeletonize(mask[window])
    if np.count_nonzero(thin) < _MIN_PATH_PX:
        return None
    skeleton = skan.Skeleton(thin)
    with warnings.catch_warnings(action="ignore"):  # skan uses deprecated functions
        branches = skan.summarize(skeleton, separator="_")
        main = skan.csr.find_main_branches(branches)
    # Each connected part of the mask has a main path: take the longest.
    part = branches["skeleton_id"].to_numpy()
    lengths = np.bincount(part[main], branches["branch_distance"].to_numpy()[main])
    main &= part == lengths.argmax()
    path = _joined([skeleton.path_coordinates(k) for k in np.flatnonzero(main)])
    corner = [window[0].start, window[1].start]
    return lifted_length((path + corner)[:, ::-1], depth_m, mask, intrinsics)


BASELINES: dict[str, Baseline] = {"skan": skan_length}


def available_baselines() -> dict[str, Baseline]:
    """Return the baselines whose packages are installed.

    Examples
    --------
    >>> set(available_baselines()) <= {"skan"}
    True
    """
    needs = {"skan": ("skan", "skimage")}
    return {
        name: function
        for name, function in BASELINES.items()
        if all(find_spec(package) for package in needs.get(name, ()))
    }


def lifted_length(
    path_px: NDArray[Any], depth_m: Array32, mask: Mask, intrinsics: Intrinsics
) -> float | None:
    """Compute the 3D length of a path of pixels.

    Each pixel is deprojected with the median of the valid readings of the mask in a 5x5 window;
    missing values are interpolated along the path. The points are smoothed along the path by a
    Savitzky-Golay filter (second order, at most 41 px), which removes the staircase of pixels and
    depth noise but keeps the ends. Without smoothing, a diagonal path would be up to 8 % too long.

    Parameters
    ----------
    path_px : ndarray, shape (N, 2)
        Pixels (u, v) in order.
    depth_m, mask, intrinsics
        See `skan_length`.

    Returns
    -------
    float or None
        Metres; None for fewer than 5 pixels or without a valid reading.

    Examples
    --------
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> path = np.stack([np.arange(200, 401), np.full(201, 240)], axis=1)
    >>> round(lifted_length(path, depth, depth > 0, camera), 6)
    0.2
    """
    from scipy.signal import savgol_filter

    if len(path_px) < _MIN_PATH_PX:
        return None
    z = _depth_along(path_px.astype(int), np.where(mask & valid_depth(depth_m), depth_m, np.nan))
    finite = np.isfinite(z)
    if not finite.any():
        return None
    place = np.arange(len(z))
    z = np.interp(place, place[finite], z[finite])
    x, y = intrinsics.rays(path_px[:, 0].astype(float), path_px[:, 1].astype(float))
    window = min(_SMOOTH_PX, len(z) - 1 + len(z) % 2)
    points = savgol_filter(np.stack([x * z, y * z, z], axis=1), window, 2, axis=0)
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _depth_along(path_px: NDArray[Any], readings_m: NDArray[Any]) -> Array:
    half = _HALF_WINDOW_PX
    depth = np.full(len(path_px), np.nan)
    for k, (u, v) in enumerate(path_px):
        window_m = readings_m[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
        valid = window_m[np.isfinite(window_m)]
        if valid.size:
            depth[k] = np.median(valid)
    return depth


def _joined(branches: list[NDArray[Any]]) -> Array:
    """Join branches end to end; neighbouring branches share an end."""
    remaining = [np.asarray(branch, float) for branch in branches]
    path = remaining.pop(0)
    while remaining:
        # Find the smallest gap between either end of the path and either end of a remaining branch.
        gaps = [
            (float(np.linalg.norm(path[end] - branch[start])), end, k, start)
            for end in (0, -1)
            for k, branch in enumerate(remaining)
            for start in (0, -1)
        ]
        _, end, k, start = min(gaps)
        branch = remaining.pop(k)
        onward = branch if start == 0 else branch[::-1]
        path = np.vstack([path, onward[1:]]) if end == -1 else np.vstack([onward[:0:-1], path])
    return path


def _package(name: str, distribution: str = "") -> ModuleType:
    try:
        return import_module(name)
    except ModuleNotFoundError:
        raise MissingExtraError(distribution or name, "benchmark") from None
