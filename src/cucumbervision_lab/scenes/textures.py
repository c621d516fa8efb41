"""Textures of leaves, surfaces and distant backgrounds, and pictures to draw them from."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.errors import CaptureError
from cucumbervision_lab.arrays import Array32, Generator, Pixels
from cucumbervision_lab.scenes import colors

_SHOWS_FRUIT = ("fruit", "rot_")

_PICTURES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}

_LIGHTS = {".hdr", ".exr"}

_SKIN_PX = 512

_LEAF_PX = 512

_BACKGROUND_PX = 1600

_LIGHT_SIZE = (128, 64)


@dataclass(frozen=True, eq=False)
class Assets:
    """Picture assets for rendering. All may be empty; everything is then generated.

    Parameters
    ----------
    skins : tuple of ndarray of uint8, shape (H, W, 3)
        Close-ups of skin, RGB, the longer side at most 512 px.
    backgrounds : tuple of ndarray of uint8, shape (H, W, 3)
        Distant backgrounds, RGB, the longer side at most 1600 px.
    environments : tuple of ndarray of float32, shape (64, 128, 3)
        Environment maps, linear RGB, equirectangular, the top row up.
    leaves : tuple of ndarray of uint8, shape (H, W, 3)
        Close-ups of leaves, RGB, the longer side at most 512 px.
    """

    skins: tuple[Pixels, ...] = ()
    backgrounds: tuple[Pixels, ...] = ()
    environments: tuple[Array32, ...] = ()
    leaves: tuple[Pixels, ...] = ()


def load_assets(folder: Path | None) -> Assets:
    """Load picture assets by the names of their folders.

    Pictures below `textures` are skins, those below `backgrounds` are backgrounds, those in a
    folder `leaves` are leaves, and `.hdr` files below a folder whose name starts with `hdri` are
    environments. Each kind is sorted by path. Backgrounds and leaves whose names contain a word of
    `_SHOWS_FRUIT` are skipped: fruit in the background would have no label.

    Parameters
    ----------
    folder : Path, optional
        Folder of the assets; without it, the result is empty.

    Returns
    -------
    Assets
        Downscaled pictures. Unreadable files are skipped with a single warning.

    Raises
    ------
    CaptureError
        If the folder does not exist or contains no assets.

    Examples
    --------
    >>> load_assets(None)
    Assets(skins=(), backgrounds=(), environments=(), leaves=())
    """
    if folder is None:
        return Assets()
    if not folder.is_dir():
        raise CaptureError(
            "folder not found", source=folder, remedy="give a folder of assets, or omit the option"
        )
    bad: list[str] = []
    assets = Assets(
        tuple(_read_all(folder, "textures/**/*", (), bad, _SKIN_PX)),
        tuple(_read_all(folder, "backgrounds/**/*", _SHOWS_FRUIT, bad, _BACKGROUND_PX)),
        tuple(_read_all(folder, "**/hdri*/**/*", (), bad)),
        tuple(_read_all(folder, "**/leaves/**/*", _SHOWS_FRUIT, bad, _LEAF_PX)),
    )
    if bad:
        names = ", ".join(sorted(set(bad)))
        warnings.warn(f"{folder}: unreadable pictures skipped: {names}", stacklevel=2)
    if not (assets.skins or assets.backgrounds or assets.environments or assets.leaves):
        raise CaptureError(
            "contains no textures, backgrounds or environment maps",
            source=folder,
            remedy="put pictures below textures/, backgrounds/ or hdri/",
        )
    return assets


def _read_all(
    folder: Path, pattern: str, without: Sequence[str], bad: list[str], longest_px: int = 0
) -> Iterator[NDArray[Any]]:
    """Yield the colour pictures that match a pattern, or its lights without a longest side.

    Unreadable files are appended to `bad`.
    """
    flag = cv2.IMREAD_COLOR if longest_px else cv2.IMREAD_UNCHANGED
    for path in sorted(set(folder.glob(pattern))):
        named = any(word.lower() in path.name.lower() for word in without)
        if named or path.suffix.lower() not in (_PICTURES if longest_px else _LIGHTS):
            continue
        # OpenCV raises for an empty file and returns None for a damaged one.
        try:
            picture = cv2.imdecode(np.fromfile(path, np.uint8), flag)
        except (OSError, cv2.error):
            picture = None
        if picture is None or picture.ndim != 3 or not np.isfinite(picture).all():
            bad.append(str(path.relative_to(folder)))
            continue
        size = _LIGHT_SIZE
        if longest_px:
            scale = min(longest_px / max(picture.shape[:2]), 1.0)
            size = tuple(round(scale * side) for side in picture.shape[1::-1])
        small = cv2.resize(picture[..., :3], size, interpolation=cv2.INTER_AREA)
        yield np.ascontiguousarray(small[..., ::-1], np.uint8 if longest_px else np.float32)


LEAF_TEXTURES = 16  # as many there are to choose from

_BLADE_PX = 192

_BLADE_LEVELS = 3

LEAF_REACH = 1.3  # the texture spans that many half axes to each side

_BASE = -0.8  # where the stalk meets the blade

_MAIN_DEG = (0.0, 42.0, 85.0, 125.0)


@lru_cache(maxsize=4 * LEAF_TEXTURES)
def leaf_texture(number: int, level: int = 0) -> Array32:
    """Generate the texture of a leaf.

    Parameters
    ----------
    number : int
        Number of the texture, from 0 to `LEAF_TEXTURES` - 1; results are cached.
    level : int
        Level of detail from `leaf_level`.

    Returns
    -------
    ndarray of float32, shape (192, 192, 4)
        Brightness with mean 1; veins, 0 to 1; slope along and across the blade for a relief of 1.
        Rows run across the blade, columns along it to the tip, over 1.3 half axes to each side.
    """
    if level:
        return _coarser(leaf_texture(number), level)
    rng = np.random.default_rng(number)
    line = ((np.arange(_BLADE_PX, dtype=np.float32) + 0.5) * (2 / _BLADE_PX) - 1) * LEAF_REACH
    s, t = np.meshgrid(line, line)
    ahead, aside = s - _BASE, np.abs(t)
    reach = np.hypot(ahead, aside)
    angle = np.arctan2(aside, ahead)
    wobble = 0.09 * colors.smooth_noise(rng, s.shape, 30)
    main = np.zeros_like(s)
    side = np.full_like(s, 9.0)
    for degrees in _MAIN_DEG:
        away = angle + wobble - np.deg2rad(degrees)
        width = 0.024 - 0.009 * np.clip(reach, 0, 2)
        off = reach * np.sin(np.clip(np.abs(away), 0, np.pi / 2))
        main = np.maximum(main, np.exp(-((off / width) ** 2)))
        side = np.minimum(side, np.abs(away))
    # Pairs of side veins branch off the main veins at regular steps.
    often = rng.uniform(3.5, 6.0)
    step = (often * reach * (1 - 0.8 * side) + 0.5 * colors.smooth_noise(rng, s.shape, 30)) % 1.0
    branch = np.exp(-(((step - 0.5) / 0.07) ** 2)) * colors.smoothstep(0.05, 0.4, reach)
    branch *= colors.smoothstep(0.75, 0.1, side) * (
        0.7 + 0.5 * colors.smooth_noise(rng, s.shape, 30)
    )
    net = np.exp(-((colors.smooth_noise(rng, s.shape, 13) / 0.14) ** 2))
    vein = np.clip(np.maximum(main, 0.5 * branch) + 0.22 * net, 0, 1)
    blisters = -0.8 * vein + 0.4 * colors.smooth_noise(rng, s.shape, 11)
    height = cv2.GaussianBlur(blisters.astype(np.float32), (0, 0), 1.8)
    across, along = np.gradient(height)
    patches = colors.smooth_noise(rng, s.shape, 50)
    grain = colors.smooth_noise(rng, s.shape, 3)
    tone = 1 + 0.14 * patches + 0.09 * grain + 0.22 * blisters
    return np.stack([tone, vein, 3.0 * along, 3.0 * across], axis=-1).astype(np.float32)


def leaf_photo_texture(rng: Generator, assets: Assets) -> tuple[Array32, ...]:
    """Crop a random leaf texture from a photo.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    assets : Assets
        Assets with `leaves`.

    Returns
    -------
    tuple of ndarray of float32, shape (192, 192, 3)
        Linear RGB divided by its mean, for each `leaf_level`; empty without leaves.
    """
    if not assets.leaves:
        return ()
    picture = assets.leaves[rng.integers(len(assets.leaves))]
    rows, columns = picture.shape[:2]
    size = int(rng.uniform(0.30, 0.5) * min(rows, columns))
    top = int(rng.uniform(0.35, 0.65) * (rows - size))
    column = int(rng.uniform(0.35, 0.65) * (columns - size))
    piece: NDArray[Any] = np.rot90(
        picture[top : top + size, column : column + size], int(rng.integers(4))
    )
    piece = cv2.resize(
        np.ascontiguousarray(piece), (_BLADE_PX, _BLADE_PX), interpolation=cv2.INTER_AREA
    )
    light = colors.to_linear(piece)
    drawing = np.asarray(np.clip(light / (light.mean(axis=(0, 1)) + 0.01), 0.15, 3.0), np.float32)
    return tuple(_coarser(drawing, level) for level in range(_BLADE_LEVELS + 1))


def leaf_level(half_px: float) -> int:
    """Return the level of detail for a leaf of `half_px` pixels from centre to tip.

    Each level halves the resolution, to avoid aliasing of veins on small leaves.

    Examples
    --------
    >>> [leaf_level(half_px) for half_px in (200.0, 74.0, 37.0, 1.0)]
    [0, 0, 1, 3]
    """
    fine = _BLADE_PX / (2 * LEAF_REACH)
    return min(max(round(float(np.log2(fine / max(half_px, 1.0)))), 0), _BLADE_LEVELS)


def _coarser(texture: Array32, level: int) -> Array32:
    # Equivalent blur at the original size.
    if level == 0:
        return texture
    return np.asarray(cv2.GaussianBlur(texture, (0, 0), 0.5 * 2.0**level))


def leaf_texel(place: Array32) -> Array32:
    """Convert a position on the blade, in half axes from its centre, to texture pixels."""
    return (place / np.float32(LEAF_REACH) + 1) * np.float32(_BLADE_PX / 2) - np.float32(0.5)


TILE_M = 0.6  # what a tile of material spans

_TILE_PX = 512

_COLORS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "wood": colors.palette("b08c62 785638 cdb491 968270"),
    "steel": colors.palette("aaacae 787c80 c8cacc"),
    "plastic": colors.palette("282a2c ebecea 285a3c 1e5096 787c80 c43c2c"),
    "cloth": colors.palette("e1dcd2 606e86 3c423c aa3c3c d6c48c"),
    "concrete": colors.palette("96948e 6e6c68 bab8b2"),
    "cardboard": colors.palette("b08e64 c4a478"),
    "paper": colors.palette("f2f2f0 e0e2e6"),
    "soil": colors.palette("564230 78624a 3c342c"),
}

MATERIALS = tuple(_COLORS)


def material_color(rng: Generator, material: str) -> tuple[float, float, float]:
    """Sample a typical colour of a material, sRGB, 0 to 255."""
    choices = _COLORS[material]
    return colors.jitter(rng, choices[rng.integers(len(choices))], 0.08)


def material_tile(
    rng: Generator, material: str, color: tuple[float, float, float], pixel_m: float = 0.0
) -> Array32:
    """Generate a tileable texture of a material.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    material : str
        One of `MATERIALS`.
    color : tuple of float
        sRGB, 0 to 255.
    pixel_m : float
        Size of a pixel on the surface, metres; finer structures are blurred to avoid aliasing.

    Returns
    -------
    ndarray of float32, shape (512, 512, 3)
        Linear RGB over 0.6 m.

    Raises
    ------
    ValueError
        If the material is unknown.
    """
    if material not in _COLORS:
        raise ValueError(f"no material {material!r}: choose one of {', '.join(MATERIALS)}")
    draw = _TONES.get(material, _even)
    tone = draw(rng)
    stain = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), 120, wrap=True)
    tone = tone * (1 + 0.06 * stain)
    tile = colors.to_linear(color) * tone[..., None]
    tile = np.asarray(np.clip(tile, 0.003, 0.95), np.float32)
    sigma_px = 0.5 * pixel_m * _TILE_PX / TILE_M
    return np.asarray(cv2.GaussianBlur(tile, (0, 0), sigma_px)) if sigma_px > 0.3 else tile


def _even(rng: Generator) -> Array32:
    fine = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), 2, wrap=True)
    tone = 1 + 0.02 * fine
    for _ in range(int(rng.integers(0, 12))):  # scratches
        a, b = rng.integers(0, _TILE_PX, (2, 2)).tolist()
        cv2.line(tone, a, b, float(rng.uniform(0.8, 1.25)), 1, cv2.LINE_AA)
    return tone


def _boards(rng: Generator) -> Array32:
    grain = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), (3, 90), wrap=True)
    broad = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), (14, 300), wrap=True)
    knots = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), (2, 40), wrap=True)
    tone = 1 + 0.12 * grain + 0.10 * broad + 0.05 * knots
    count = int(rng.integers(1, 9))
    board = np.arange(_TILE_PX) * count // _TILE_PX
    tone = tone * rng.uniform(0.8, 1.15, count).astype(np.float32)[board][:, None]
    if count > 1:
        edge = np.flatnonzero(np.diff(board))
        tone[edge] *= 0.35
        tone[np.minimum(edge + 1, _TILE_PX - 1)] *= 0.6
    return np.asarray(tone, np.float32)


def _brushed(rng: Generator) -> Array32:
    lines = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), (1, 200), wrap=True)
    return np.asarray(
        1 + 0.05 * lines + 0.05 * colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), (200, 90))
    )


def _woven(rng: Generator) -> Array32:
    period = float(rng.uniform(4, 9))
    line = np.arange(_TILE_PX, dtype=np.float32)
    weave = np.sin(2 * np.pi * line / period)[:, None] * np.sin(2 * np.pi * line / period)
    tone = 1 + 0.12 * weave + 0.06 * colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), 2)
    if rng.random() < 0.5:  # checks
        check_period = float(rng.uniform(30, 90))
        check = 0.5 * ((line // check_period) % 2)
        tone *= 1 - 0.35 * (check[:, None] + check)
    return np.asarray(
        tone * (1 + 0.1 * colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), 90)), np.float32
    )


def _rough(rng: Generator) -> Array32:
    layers = [(60, 0.12), (12, 0.10), (3, 0.10)]
    tone = np.ones((_TILE_PX, _TILE_PX), np.float32)
    for grain, spread in layers:
        tone += spread * colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), grain, wrap=True)
    return np.clip(tone, 0.2, 2)


def _clods(rng: Generator) -> Array32:
    clod = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), 14, wrap=True)
    crumb = colors.smooth_noise(rng, (_TILE_PX, _TILE_PX), 4, wrap=True)
    return np.clip(1 + 0.4 * clod + 0.35 * crumb, 0.12, 2.2)


_TONES: dict[str, Callable[[Generator], Array32]] = {
    "wood": _boards,
    "steel": _brushed,
    "cloth": _woven,
    "concrete": _rough,
    "cardboard": _rough,
    "soil": _clods,
}


def far_view(rng: Generator, kind: str, width: int, height: int, assets: Assets) -> Array32:
    """Generate a distant background.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    kind : str
        "photo" (from the assets, or "leaves" without any), "leaves", "film" (a pale wall of plastic
        or glass) or "dark".
    width, height : int
        Pixels.
    assets : Assets
        Assets with backgrounds.

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


def _photo(rng: Generator, pictures: tuple[Pixels, ...], width: int, height: int) -> Array32:
    picture = pictures[rng.integers(len(pictures))]
    rows, columns = picture.shape[:2]
    scale = rng.uniform(0.5, 1.0) * min(columns / width, rows / height)
    width_px, tall = max(int(scale * width), 2), max(int(scale * height), 2)
    top, column = int(rng.integers(rows - tall + 1)), int(rng.integers(columns - width_px + 1))
    piece: NDArray[Any] = picture[top : top + tall, column : column + width_px]
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    piece = cv2.resize(np.ascontiguousarray(piece), (width, height), interpolation=cv2.INTER_LINEAR)
    tone = np.exp(rng.normal(0, 0.3)) * (1 + 0.08 * rng.standard_normal(3))
    light = colors.to_linear(piece) * tone.astype(np.float32)
    blur = rng.uniform(0, 2.5) * width / 1280
    return np.asarray(cv2.GaussianBlur(light, (0, 0), blur) if blur > 0.3 else light)


def _pale(rng: Generator, width: int, height: int, level: float) -> Array32:
    tone = 1 + 0.12 * colors.smooth_noise(rng, (height, width), width / 3)
    tone += 0.25 * rng.normal() * np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    tone = np.clip(tone, 0.1, 3).astype(np.float32)
    for _ in range(int(rng.integers(0, 7))):  # bars, gutters, posts
        x = int(rng.integers(width))
        thick = int(rng.integers(1, max(width // 60, 2) + 1))
        lean = int(rng.normal(0, width / 40))
        cv2.line(tone, (x, 0), (x + lean, height), float(rng.uniform(0.3, 1.3)), thick, cv2.LINE_AA)
    hue = 1 + 0.05 * rng.standard_normal(3)
    return np.asarray(level * tone[..., None] * hue, np.float32)


def _blurred_leaves(rng: Generator, width: int, height: int) -> Array32:
    shape = height // 4 + 1, width // 4 + 1
    tone = colors.smooth_noise(rng, shape, width / 40) + 0.6 * colors.smooth_noise(
        rng, shape, width / 110
    )
    dark = colors.to_linear(colors.jitter(rng, (30.0, 44.0, 26.0)))
    light = colors.to_linear(colors.jitter(rng, (104.0, 136.0, 66.0)))
    view: NDArray[Any] = colors.mix(dark, light, colors.smoothstep(-1.2, 1.4, tone))
    gap = colors.smoothstep(
        1.0, 1.3, colors.smooth_noise(rng, shape, width / 60) + rng.uniform(-0.4, 0.3)
    )
    view = colors.mix(view, (0.8, 0.85, 0.9), gap)
    view = cv2.GaussianBlur(view, (0, 0), rng.uniform(0.6, 3.0))
    level = np.float32(rng.uniform(0.15, 0.8))
    return np.asarray(level * cv2.resize(view, (width, height), interpolation=cv2.INTER_LINEAR))
