"""What fruit lie on and hang before: boards, steel, plastic, cloth, concrete, crates, far views."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision_lab.synthesis.tones import jitter, mix, smooth_noise, smoothstep, to_linear

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from cucumbervision_lab.synthesis.assets import Assets

__all__ = ["MATERIALS", "TILE_M", "far_view", "material_color", "material_tile"]

TILE_M = 0.6  # what a tile of material spans
_SIZE = 512

_COLORS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "wood": ((176, 140, 98), (120, 86, 56), (205, 180, 145), (150, 130, 112)),
    "steel": ((170, 172, 174), (120, 124, 128), (200, 202, 204)),
    "plastic": (
        (40, 42, 44),
        (235, 236, 234),
        (40, 90, 60),
        (30, 80, 150),
        (120, 124, 128),
        (196, 60, 44),
    ),
    "cloth": ((225, 220, 210), (96, 110, 134), (60, 66, 60), (170, 60, 60), (214, 196, 140)),
    "concrete": ((150, 148, 142), (110, 108, 104), (186, 184, 178)),
    "cardboard": ((176, 142, 100), (196, 164, 120)),
    "paper": ((242, 242, 240), (224, 226, 230)),
    "soil": ((86, 66, 48), (120, 98, 74), (60, 52, 44)),
    "mesh": ((34, 36, 38), (50, 120, 70), (40, 100, 170)),
    "film": ((228, 230, 232), (190, 196, 198), (160, 166, 168)),
}
MATERIALS = tuple(_COLORS)


def material_color(rng: np.random.Generator, material: str) -> tuple[float, float, float]:
    """Draw a colour that a material comes in, sRGB, 0 to 255."""
    choices = _COLORS[material]
    return jitter(rng, choices[rng.integers(len(choices))], 0.08)


def material_tile(
    rng: np.random.Generator,
    material: str,
    color: tuple[float, float, float],
    pixel_m: float = 0.0,
) -> NDArray[np.float32]:
    """Draw a material.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance.
    material : str
        One of `MATERIALS`.
    color : tuple of float
        sRGB, 0 to 255.
    pixel_m : float
        What a pixel of the picture spans on it, metres: finer grain would flicker, and is blurred.

    Returns
    -------
    ndarray of float32, shape (512, 512, 3)
        Linear RGB over 0.6 m.

    Raises
    ------
    ValueError
        If there is no such material.
    """
    if material not in _COLORS:
        raise ValueError(f"no material {material!r}: choose one of {', '.join(MATERIALS)}")
    draw = _TONES.get(material, _even)
    tone = draw(rng)
    stain = smooth_noise(rng, (_SIZE, _SIZE), 120, wrap=True)
    tone = tone * (1 + 0.06 * stain)
    tile = to_linear(color) * tone[..., None]
    tile = np.asarray(np.clip(tile, 0.003, 0.95), np.float32)
    sigma_px = 0.5 * pixel_m * _SIZE / TILE_M
    return np.asarray(cv2.GaussianBlur(tile, (0, 0), sigma_px)) if sigma_px > 0.3 else tile


def _even(rng: np.random.Generator) -> NDArray[np.float32]:
    fine = smooth_noise(rng, (_SIZE, _SIZE), 2, wrap=True)
    tone = 1 + 0.02 * fine
    for _ in range(int(rng.integers(0, 12))):  # scratches
        a, b = rng.integers(0, _SIZE, (2, 2)).tolist()
        cv2.line(tone, a, b, float(rng.uniform(0.8, 1.25)), 1, cv2.LINE_AA)
    return tone


def _boards(rng: np.random.Generator) -> NDArray[np.float32]:
    grain = smooth_noise(rng, (_SIZE, _SIZE), (3, 90), wrap=True)
    broad = smooth_noise(rng, (_SIZE, _SIZE), (14, 300), wrap=True)
    knots = smooth_noise(rng, (_SIZE, _SIZE), (2, 40), wrap=True)
    tone = 1 + 0.12 * grain + 0.10 * broad + 0.05 * knots
    count = int(rng.integers(1, 9))
    board = np.arange(_SIZE) * count // _SIZE
    tone = tone * rng.uniform(0.8, 1.15, count).astype(np.float32)[board][:, None]
    if count > 1:
        edge = np.flatnonzero(np.diff(board))
        tone[edge] *= 0.35
        tone[np.minimum(edge + 1, _SIZE - 1)] *= 0.6
    return np.asarray(tone, np.float32)


def _brushed(rng: np.random.Generator) -> NDArray[np.float32]:
    lines = smooth_noise(rng, (_SIZE, _SIZE), (1, 200), wrap=True)
    return np.asarray(1 + 0.05 * lines + 0.05 * smooth_noise(rng, (_SIZE, _SIZE), (200, 90)))


def _woven(rng: np.random.Generator) -> NDArray[np.float32]:
    period = float(rng.uniform(4, 9))
    line = np.arange(_SIZE, dtype=np.float32)
    weave = np.sin(2 * np.pi * line / period)[:, None] * np.sin(2 * np.pi * line / period)
    tone = 1 + 0.12 * weave + 0.06 * smooth_noise(rng, (_SIZE, _SIZE), 2)
    if rng.random() < 0.5:  # checks
        wide = float(rng.uniform(30, 90))
        check = 0.5 * ((line // wide) % 2)
        tone *= 1 - 0.35 * (check[:, None] + check)
    return np.asarray(tone * (1 + 0.1 * smooth_noise(rng, (_SIZE, _SIZE), 90)), np.float32)


def _rough(rng: np.random.Generator) -> NDArray[np.float32]:
    layers = [(60, 0.12), (12, 0.10), (3, 0.10)]
    tone = np.ones((_SIZE, _SIZE), np.float32)
    for grain, spread in layers:
        tone += spread * smooth_noise(rng, (_SIZE, _SIZE), grain, wrap=True)
    return np.clip(tone, 0.2, 2)


def _clods(rng: np.random.Generator) -> NDArray[np.float32]:
    clod = smooth_noise(rng, (_SIZE, _SIZE), 14, wrap=True)
    crumb = smooth_noise(rng, (_SIZE, _SIZE), 4, wrap=True)
    return np.clip(1 + 0.4 * clod + 0.35 * crumb, 0.12, 2.2)


def _holes(rng: np.random.Generator) -> NDArray[np.float32]:
    period, share = float(rng.uniform(20, 60)), float(rng.uniform(0.45, 0.75))
    line = np.arange(_SIZE, dtype=np.float32)
    row, column = np.abs((line / period) % 1 - 0.5)[:, None], np.abs((line / period) % 1 - 0.5)
    slanted = rng.random() < 0.5
    far = row + column if slanted else np.maximum(row, column)
    hole = smoothstep(0.5 * share + 0.03, 0.5 * share - 0.03, far)
    return np.asarray((1 - 0.9 * hole) * (1 + 0.03 * smooth_noise(rng, (_SIZE, _SIZE), 3)))


_TONES: dict[str, Callable[[np.random.Generator], NDArray[np.float32]]] = {
    "wood": _boards,
    "steel": _brushed,
    "cloth": _woven,
    "concrete": _rough,
    "cardboard": _rough,
    "soil": _clods,
    "mesh": _holes,
}


def far_view(
    rng: np.random.Generator, kind: str, width: int, height: int, assets: Assets
) -> NDArray[np.float32]:
    """Draw what lies far behind, its own light included.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance.
    kind : str
        "photo" (of the assets; leaves without any), "leaves", "film" (a pale wall of plastic or
        glass), "dark".
    width, height : int
        Pixels.
    assets : Assets
        For their backgrounds.

    Returns
    -------
    ndarray of float32, shape (height, width, 3)
        Linear RGB.
    """
    if kind == "photo" and assets.backgrounds:
        return _photo(rng, assets.backgrounds, width, height)
    if kind in ("film", "dark"):
        return _pale(rng, width, height, float(rng.uniform(0.3, 1.6)) if kind == "film" else 0.03)
    return _blurred_leaves(rng, width, height)


def _photo(
    rng: np.random.Generator, pictures: tuple[NDArray[np.uint8], ...], width: int, height: int
) -> NDArray[np.float32]:
    picture = pictures[rng.integers(len(pictures))]
    rows, columns = picture.shape[:2]
    scale = rng.uniform(0.5, 1.0) * min(columns / width, rows / height)
    wide, tall = max(int(scale * width), 2), max(int(scale * height), 2)
    top, left = int(rng.integers(rows - tall + 1)), int(rng.integers(columns - wide + 1))
    piece: NDArray[Any] = picture[top : top + tall, left : left + wide]
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    piece = cv2.resize(np.ascontiguousarray(piece), (width, height), interpolation=cv2.INTER_LINEAR)
    tone = np.exp(rng.normal(0, 0.3)) * (1 + 0.08 * rng.standard_normal(3))
    light = to_linear(piece) * tone.astype(np.float32)
    blur = rng.uniform(0, 2.5) * width / 1280
    return np.asarray(cv2.GaussianBlur(light, (0, 0), blur) if blur > 0.3 else light)


def _pale(rng: np.random.Generator, width: int, height: int, level: float) -> NDArray[np.float32]:
    tone = 1 + 0.12 * smooth_noise(rng, (height, width), width / 3)
    tone += 0.25 * rng.normal() * np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    tone = np.clip(tone, 0.1, 3).astype(np.float32)
    for _ in range(int(rng.integers(0, 7))):  # bars, gutters, posts
        x = int(rng.integers(width))
        thick = int(rng.integers(1, max(width // 60, 2) + 1))
        lean = int(rng.normal(0, width / 40))
        cv2.line(tone, (x, 0), (x + lean, height), float(rng.uniform(0.3, 1.3)), thick, cv2.LINE_AA)
    hue = 1 + 0.05 * rng.standard_normal(3)
    return np.asarray(level * tone[..., None] * hue, np.float32)


def _blurred_leaves(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float32]:
    shape = height // 4 + 1, width // 4 + 1
    tone = smooth_noise(rng, shape, width / 40) + 0.6 * smooth_noise(rng, shape, width / 110)
    dark = to_linear(jitter(rng, (30.0, 44.0, 26.0)))
    light = to_linear(jitter(rng, (104.0, 136.0, 66.0)))
    view: NDArray[Any] = mix(dark, light, smoothstep(-1.2, 1.4, tone))
    gap = smoothstep(1.0, 1.3, smooth_noise(rng, shape, width / 60) + rng.uniform(-0.4, 0.3))
    view = mix(view, (0.8, 0.85, 0.9), gap)
    view = cv2.GaussianBlur(view, (0, 0), rng.uniform(0.6, 3.0))
    level = np.float32(rng.uniform(0.15, 0.8))
    return np.asarray(level * cv2.resize(view, (width, height), interpolation=cv2.INTER_LINEAR))
