"""Shadows from what the camera sees: of the sun, of leaves out of sight, and where things meet.

All of it is worked out on a small picture and drawn up: shadows are soft.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision_lab.synthesis.tones import sample, smooth_noise, smoothstep

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision_lab.synthesis.light import Light

__all__ = ["corners", "spots", "sun_shadow"]

_WIDE = 320  # pixels of the small picture
_STEPS = 14
_REACH_M = 0.40
_TILE = 256
# A small pixel astride an outline would leave a bright rim about what stands before: the darker of
# neighbours counts.
_AROUND = np.ones((3, 3), np.uint8)


def _small(depth_m: NDArray[np.float32]) -> tuple[int, NDArray[np.float32]]:
    step = max(round(depth_m.shape[1] / _WIDE), 1)
    return step, np.ascontiguousarray(depth_m[::step, ::step])


def _points(
    depth_m: NDArray[np.float32], step: int, camera: Intrinsics
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rows, columns = depth_m.shape
    x = ((step * np.arange(columns) - camera.cx_px) / camera.fx_px).astype(np.float32)
    y = ((step * np.arange(rows) - camera.cy_px) / camera.fy_px).astype(np.float32)
    return x * depth_m, y[:, None] * depth_m


def _grown(small: NDArray[Any], shape: tuple[int, ...], step: int) -> NDArray[np.float32]:
    grown = cv2.resize(
        small,
        (small.shape[1] * step, small.shape[0] * step),
        interpolation=cv2.INTER_LINEAR,
    )
    return np.asarray(grown[: shape[0], : shape[1]])


def sun_shadow(
    rng: np.random.Generator, depth_m: NDArray[np.float32], camera: Intrinsics, light: Light
) -> NDArray[np.float32]:
    """Say how much of the sun each pixel gets, as far as the picture tells.

    From each point a few steps are taken towards the sun; where the picture shows something
    nearer to the camera than such a step, and not far nearer, that thing is in the way.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance: steps are jittered, which makes soft edges.
    depth_m : ndarray of float32, shape (H, W)
        Metres, far where nothing is.
    camera : Intrinsics
        Who looks; its distortion is left out of account.
    light : Light
        Whose sun.

    Returns
    -------
    ndarray of float32, shape (H, W)
        0 in shadow, 1 in the sun.
    """
    step, small = _small(depth_m)
    rows, columns = small.shape
    x, y = _points(small, step, camera)
    shift = rng.random(small.shape, dtype=np.float32)
    hidden = np.zeros(small.shape, np.bool_)
    focus, middle = (camera.fx_px / step, camera.fy_px / step), (camera.cx_px, camera.cy_px)
    for k in range(_STEPS):
        way = (0.006 + _REACH_M * ((k + shift) / _STEPS) ** 1.7).astype(np.float32)
        z = small + way * np.float32(light.sun[2])
        np.maximum(z, 0.05, out=z)
        u = (x + way * np.float32(light.sun[0])) / z * np.float32(focus[0])
        v = (y + way * np.float32(light.sun[1])) / z * np.float32(focus[1])
        column = np.rint(u + np.float32(middle[0] / step)).astype(np.int32)
        row = np.rint(v + np.float32(middle[1] / step)).astype(np.int32)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        np.clip(column, 0, columns - 1, out=column)
        np.clip(row, 0, rows - 1, out=row)
        ahead = z - small[row, column]
        hidden |= inside & (ahead > 0.004 + 0.04 * way) & (ahead < 0.05 + 0.5 * way)
    lit = cv2.GaussianBlur(1 - hidden.astype(np.float32), (0, 0), 1.0)
    return _grown(cv2.erode(lit, _AROUND), depth_m.shape, step)


def spots(
    rng: np.random.Generator, depth_m: NDArray[np.float32], camera: Intrinsics, light: Light
) -> NDArray[np.float32]:
    """Say how much of the sun leaves out of sight let through.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance.
    depth_m : ndarray of float32, shape (H, W)
        Metres.
    camera : Intrinsics
        Who looks.
    light : Light
        Its sun's direction, `shade` and `spot_m`.

    Returns
    -------
    ndarray of float32, shape (H, W)
        1 - shade to 1.
    """
    step, small = _small(depth_m)
    x, y = _points(small, step, camera)
    sun = np.asarray(light.sun)
    aside = np.cross(sun, (0.3, 0.1, 1.0))
    aside /= np.linalg.norm(aside)
    other = np.cross(sun, aside)
    scale = 16.0 / light.spot_m
    u, v = (
        (scale * (a[0] * x + a[1] * y + a[2] * small)).astype(np.float32).ravel() % _TILE
        for a in (aside, other)
    )
    tile = smooth_noise(rng, (_TILE, _TILE), 16, wrap=True)
    tile += 0.5 * smooth_noise(rng, (_TILE, _TILE), 7, wrap=True)
    level = rng.uniform(-0.5, 0.6)
    through = smoothstep(level - 0.12, level + 0.12, sample(tile, u, v)).reshape(small.shape)
    return 1 - np.float32(light.shade) * (1 - _grown(through, depth_m.shape, step))


def corners(depth_m: NDArray[np.float32], strength: float = 1.0) -> NDArray[np.float32]:
    """Say how open each pixel lies to the light all around, by what stands out before it.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres.
    strength : float
        0 leaves all open.

    Returns
    -------
    ndarray of float32, shape (H, W)
        Above 0 (deep between things) to 1 (open).

    Notes
    -----
    Unsharp masking of the depth (Luft, Colditz and Deussen, SIGGRAPH 2006), at three scales, on
    1 / depth so that what is far stays far.
    """
    step, small = _small(depth_m)
    near = 1 / small
    closed = np.zeros(small.shape, np.float32)
    for sigma, weight in ((2.5, 0.4), (7.0, 0.35), (18.0, 0.25)):
        around = cv2.GaussianBlur(near, (0, 0), sigma)
        before = np.maximum(around - near, 0) * small
        # What stands far before hides little of the light.
        closed += weight * before / (before + 0.010) * 0.08 / (before + 0.08)
    opened = 1 - np.float32(0.95 * strength) * closed
    return _grown(cv2.erode(opened, _AROUND), depth_m.shape, step)
