"""Leaves up close: veins, blisters, spots, and the slopes they make, as small textures."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision_lab.synthesis.tones import smooth_noise, smoothstep, to_linear

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_lab.synthesis.assets import Assets

__all__ = ["BLADES", "blade_level", "blade_photo", "blade_pixel", "blade_texture"]

BLADES = 16  # as many there are to choose from

_SIZE = 192
_LEVELS = 3
_REACH = 1.3  # the texture spans that many half axes to each side
_BASE = -0.8  # where the stalk meets the blade
_MAIN_DEG = (0.0, 42.0, 85.0, 125.0)


@lru_cache(maxsize=4 * BLADES)
def blade_texture(number: int, level: int = 0) -> NDArray[np.float32]:
    """Draw a leaf's blade.

    Parameters
    ----------
    number : int
        Which of them, from 0 to `BLADES` - 1; each is drawn once and kept.
    level : int
        How coarse, as `blade_level` says.

    Returns
    -------
    ndarray of float32, shape (192, 192, 4)
        Tone about 1; vein, 0 to 1; slope along and across the blade, for relief 1. Rows run
        across the blade, columns along it to its tip, over 1.3 half axes to each side.
    """
    if level:
        return _coarser(blade_texture(number), level)
    rng = np.random.default_rng(number)
    line = ((np.arange(_SIZE, dtype=np.float32) + 0.5) * (2 / _SIZE) - 1) * _REACH
    s, t = np.meshgrid(line, line)
    ahead, aside = s - _BASE, np.abs(t)
    reach = np.hypot(ahead, aside)
    angle = np.arctan2(aside, ahead)
    wobble = 0.09 * smooth_noise(rng, s.shape, 30)
    main = np.zeros_like(s)
    side = np.full_like(s, 9.0)
    for degrees in _MAIN_DEG:
        away = angle + wobble - np.deg2rad(degrees)
        wide = 0.024 - 0.009 * np.clip(reach, 0, 2)
        off = reach * np.sin(np.clip(np.abs(away), 0, np.pi / 2))
        main = np.maximum(main, np.exp(-((off / wide) ** 2)))
        side = np.minimum(side, np.abs(away))
    # Side veins leave the main ones forward, each pair a step farther out.
    often = rng.uniform(3.5, 6.0)
    step = (often * reach * (1 - 0.8 * side) + 0.5 * smooth_noise(rng, s.shape, 30)) % 1.0
    branch = np.exp(-(((step - 0.5) / 0.07) ** 2)) * smoothstep(0.05, 0.4, reach)
    branch *= smoothstep(0.75, 0.1, side) * (0.7 + 0.5 * smooth_noise(rng, s.shape, 30))
    net = np.exp(-((smooth_noise(rng, s.shape, 13) / 0.14) ** 2))
    vein = np.clip(np.maximum(main, 0.5 * branch) + 0.22 * net, 0, 1)
    blisters = -0.8 * vein + 0.4 * smooth_noise(rng, s.shape, 11)
    height = cv2.GaussianBlur(blisters.astype(np.float32), (0, 0), 1.8)
    across, along = np.gradient(height)
    patches = smooth_noise(rng, s.shape, 50)
    grain = smooth_noise(rng, s.shape, 3)
    tone = 1 + 0.14 * patches + 0.09 * grain + 0.22 * blisters
    return np.stack([tone, vein, 3.0 * along, 3.0 * across], axis=-1).astype(np.float32)


def blade_photo(rng: np.random.Generator, assets: Assets) -> tuple[NDArray[np.float32], ...]:
    """Cut a piece of a leaf out of a photo.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance.
    assets : Assets
        Whose `leaves` to cut from.

    Returns
    -------
    tuple of ndarray of float32, shape (192, 192, 3)
        Linear RGB over its own mean, a third to half of the photo, for each `blade_level`; empty
        without leaves.
    """
    if not assets.leaves:
        return ()
    picture = assets.leaves[rng.integers(len(assets.leaves))]
    rows, columns = picture.shape[:2]
    size = int(rng.uniform(0.30, 0.5) * min(rows, columns))
    top = int(rng.uniform(0.35, 0.65) * (rows - size))
    left = int(rng.uniform(0.35, 0.65) * (columns - size))
    piece: NDArray[Any] = np.rot90(
        picture[top : top + size, left : left + size], int(rng.integers(4))
    )
    piece = cv2.resize(np.ascontiguousarray(piece), (_SIZE, _SIZE), interpolation=cv2.INTER_AREA)
    light = to_linear(piece)
    drawing = np.asarray(np.clip(light / (light.mean(axis=(0, 1)) + 0.01), 0.15, 3.0), np.float32)
    return tuple(_coarser(drawing, level) for level in range(_LEVELS + 1))


def blade_level(half_px: float) -> int:
    """Say how often a texture must be halved for a leaf of so many pixels from middle to tip.

    Without it veins would flicker on small leaves.

    Examples
    --------
    >>> [blade_level(half_px) for half_px in (200.0, 74.0, 37.0, 1.0)]
    [0, 0, 1, 3]
    """
    fine = _SIZE / (2 * _REACH)
    return min(max(round(float(np.log2(fine / max(half_px, 1.0)))), 0), _LEVELS)


def _coarser(texture: NDArray[np.float32], level: int) -> NDArray[np.float32]:
    # Blurred as much as halving it so often would; its size stays.
    if level == 0:
        return texture
    return np.asarray(cv2.GaussianBlur(texture, (0, 0), 0.5 * 2.0**level))


def blade_pixel(place: NDArray[np.float32]) -> NDArray[np.float32]:
    """Turn a place on the blade, in half axes from its middle, to the texture's pixel."""
    return (place / np.float32(_REACH) + 1) * np.float32(_SIZE / 2) - np.float32(0.5)
