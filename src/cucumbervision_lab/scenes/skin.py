"""Procedural cucumber skin by variety, as unrolled textures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision_lab.arrays import Array32, Generator, Pixels
from cucumbervision_lab.scenes import colors
from cucumbervision_lab.scenes.colors import Color

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_lab.scenes.textures import Assets


_ROWS, _COLUMNS = (24, 1100), (24, 560)
_TILE_M = 0.05  # what a close-up of skin shows from side to side


@dataclass(frozen=True)
class Skin:
    """Appearance parameters of one fruit.

    Parameters
    ----------
    base, tip, stripe : tuple of float
        Colours of body, blossom end and stripes, sRGB, 0 to 255.
    stripes : int
        Number of stripes around the fruit.
    stripe_strength, stripe_reach : float
        Contrast of the stripes, 0 to 1; their length from the blossom end, as a share.
    tip_reach : float
        Extent of the blossom end's colour, as a share of the length.
    mottle : float
        Variation of the skin's brightness.
    warts_per_cm2, wart_m : float
        Density and height of warts, 1/cm² and metres.
    wart_tone : float
        Brightness of a wart relative to the skin.
    ridges : int
        Number of ridges around the fruit.
    ridge_m : float
        Height of the ridges, metres.
    gloss : float
        Gloss, 0 to 1.
    bloom : float
        Amount of whitish wax, 0 to 1.
    neck : float
        Paleness of the stem end, 0 to 1.
    texture : int
        Index of a close-up among the assets; -1 for none.
    """

    base: Color
    tip: Color
    stripe: Color
    stripes: int = 10
    stripe_strength: float = 0.3
    stripe_reach: float = 0.6
    tip_reach: float = 0.25
    mottle: float = 0.08
    warts_per_cm2: float = 0.0
    wart_m: float = 0.0006
    wart_tone: float = 1.3
    ridges: int = 10
    ridge_m: float = 0.0002
    gloss: float = 0.6
    bloom: float = 0.1
    neck: float = 0.4
    texture: int = -1


@dataclass(frozen=True, eq=False)
class SkinMaps:
    """Unrolled skin of a fruit: rows from blossom end to stem end, columns around the axis.

    Parameters
    ----------
    albedo : ndarray of float32, shape (A, C, 3)
        Linear RGB.
    relief : ndarray of float32, shape (A, C, 3)
        Slope along and around the fruit (metres per metre), and gloss, 0 to 1.
    height_m : ndarray of float32, shape (A, C)
        Height of warts and ridges, metres.
    """

    albedo: Array32
    relief: Array32
    height_m: Array32


@dataclass(frozen=True)
class _Look:
    bases: tuple[Color, ...]
    tips: tuple[Color, ...]
    stripe_strength: tuple[float, float]
    warts_per_cm2: tuple[float, float]
    wart_m: tuple[float, float]
    ridge_m: tuple[float, float]
    gloss: tuple[float, float]
    tip_reach: tuple[float, float]


_DARK = colors.palette("1c421e 244e22 305c28 1e4830")
_FRESH = colors.palette("3e7224 4e8228 346624")
_BRIGHT = colors.palette("60962e 729e34 549024")
_PALE = colors.palette("80a056 96b06c b0c082 becca0")
_YELLOW = colors.palette("96a446 acb058 809840")

LOOKS: dict[str, _Look] = {
    # smooth, dark, long: under glass
    "long": _Look(
        _DARK + _FRESH + _BRIGHT[:2],
        (_FRESH[1], _YELLOW[2], _FRESH[0]),
        *((0.0, 0.35), (0.0, 0.3), (0.0001, 0.0004)),
        *((0.0001, 0.0011), (0.35, 0.9), (0.04, 0.35)),
    ),
    # spiny, warty: slicers
    "slicing": _Look(
        _DARK + _FRESH[:2] + _BRIGHT[2:],
        (_YELLOW[2], _PALE[0], _FRESH[1]),
        *((0.1, 0.55), (0.6, 3.0), (0.0004, 0.0011)),
        *((0.0001, 0.0006), (0.35, 0.8), (0.15, 0.6)),
    ),
    # pale, striped: Asian and white-green
    "pale": _Look(
        _PALE[:3] + _FRESH[1:2],
        (_PALE[2], _YELLOW[1], _PALE[3]),
        *((0.2, 0.8), (0.0, 1.5), (0.0002, 0.0008)),
        *((0.0, 0.0009), (0.15, 0.6), (0.2, 0.8)),
    ),
    # small and smooth: snacks
    "mini": _Look(
        _FRESH + _DARK[1:3] + _BRIGHT,
        (_YELLOW[2], _FRESH[1], _PALE[0]),
        *((0.0, 0.4), (0.0, 0.2), (0.0001, 0.0003)),
        *((0.0002, 0.0008), (0.5, 1.0), (0.05, 0.4)),
    ),
    # stout and bumpy, light towards the blossom: gherkins
    "pickling": _Look(
        _FRESH + _DARK[2:3] + _BRIGHT[1:],
        (_PALE[1], _PALE[0], _YELLOW[1]),
        *((0.25, 0.9), (1.0, 4.0), (0.0005, 0.0013)),
        *((0.0, 0.0005), (0.2, 0.6), (0.3, 0.8)),
    ),
}


def random_skin(rng: Generator, variety: str, assets: Assets) -> Skin:
    """Sample the skin of a fruit.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    variety : str
        One of `LOOKS`: "long", "slicing", "pale", "mini", "pickling".
    assets : Assets
        Close-ups of skin, used with a probability of 0.5 if available.

    Raises
    ------
    ValueError
        If the variety is unknown.

    Examples
    --------
    >>> from cucumbervision_lab.scenes.textures import Assets
    >>> skin = random_skin(np.random.default_rng(1), "slicing", Assets())
    >>> skin.warts_per_cm2 > 0.5, skin.texture
    (True, -1)
    """
    if variety not in LOOKS:
        raise ValueError(f"no variety {variety!r}: choose one of {', '.join(LOOKS)}")
    look = LOOKS[variety]

    def between(limits: tuple[float, float]) -> float:
        return float(rng.uniform(*limits))

    base = colors.jitter(rng, look.bases[rng.integers(len(look.bases))])
    tip = colors.jitter(rng, look.tips[rng.integers(len(look.tips))])
    pale = colors.jitter(rng, _PALE[rng.integers(len(_PALE))])
    photo = bool(assets.skins) and rng.random() < 0.5
    return Skin(
        base=base,
        tip=tip,
        stripe=pale,
        stripes=int(rng.integers(8, 13)),
        stripe_strength=between(look.stripe_strength),
        stripe_reach=between((0.25, 1.3)),
        tip_reach=between(look.tip_reach),
        mottle=between((0.03, 0.16)),
        warts_per_cm2=between(look.warts_per_cm2),
        wart_m=between(look.wart_m),
        wart_tone=between((0.7, 1.8)),
        ridges=int(rng.integers(7, 12)),
        ridge_m=between(look.ridge_m),
        gloss=between(look.gloss),
        bloom=float(rng.beta(1.2, 4.0)),
        neck=between((0.1, 0.65)),
        texture=int(rng.integers(len(assets.skins))) if photo else -1,
    )


def skin_maps(
    rng: Generator, skin: Skin, length_m: float, radius_m: float, texel_m: float, assets: Assets
) -> SkinMaps:
    """Generate the texture maps of a skin.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    skin : Skin
        Appearance parameters.
    length_m, radius_m : float
        Length from pole to pole, and radius, metres.
    texel_m : float
        Size of a texel, metres; about that of a pixel on the fruit.
    assets : Assets
        Assets that `skin.texture` refers to.

    Returns
    -------
    SkinMaps
        Maps that are periodic around the fruit.
    """
    rows = int(np.clip(np.ceil(length_m / texel_m), *_ROWS))
    columns = int(np.clip(np.ceil(2 * np.pi * radius_m / texel_m), *_COLUMNS))
    row_m, column_m = length_m / rows, 2 * np.pi * radius_m / columns
    along = ((np.arange(rows, dtype=np.float32) + 0.5) / rows)[:, None]
    around = (2 * np.pi * (np.arange(columns, dtype=np.float32) + 0.5) / columns)[None, :]

    def noise(grain_m: float, stretch: float = 1.0) -> Array32:
        grain = (stretch * grain_m / row_m, grain_m / column_m)
        return colors.smooth_noise(rng, (rows, columns), grain, wrap=True)

    coarse, fine = noise(0.012, 2.5), noise(0.0016, 1.5)
    wobble = 0.25 * coarse
    color = _ground(skin, along, around, coarse, fine, assets, (row_m, column_m))
    warts, height = _warts(rng, skin, (rows, columns), (row_m, column_m))
    ridges = np.cos(skin.ridges * around + wobble)
    height += 0.5 * skin.ridge_m * ridges * colors.smoothstep(0.0, 0.08, along * (1 - along) * 4)
    height += 0.00012 * coarse + 0.000015 * fine
    tone = 1 + 0.12 * min(skin.ridge_m / 0.0005, 1.5) * ridges
    color = colors.scale_colors(color, tone * (1 + (skin.wart_tone - 1) * warts))
    color = _ends(skin, color, along * length_m, length_m, wobble + 0.2 * fine)
    wax = np.clip(skin.bloom * (0.5 + 0.6 * coarse), 0, 0.5).astype(np.float32)
    color = colors.mix(color, colors.to_linear((196.0, 208.0, 196.0)), 0.4 * wax)
    gloss = np.clip(skin.gloss * (1 - 0.9 * wax) * (1 + 0.15 * fine), 0, 1)
    relief = np.stack([*_slopes(height, row_m, column_m), gloss], axis=-1)
    return SkinMaps(
        np.clip(color, 0.002, 0.9), relief.astype(np.float32), height.astype(np.float32)
    )


def _ground(
    skin: Skin,
    along: NDArray[Any],
    around: NDArray[Any],
    coarse: Array32,
    fine: Array32,
    assets: Assets,
    texel_m: tuple[float, float],
) -> Array32:
    # Yellow towards the blossom end, stripes from the blossom end, mottling.
    ripe = colors.smoothstep(skin.tip_reach, 0.0, along + 0.06 * coarse)
    color = colors.mix(colors.to_linear(skin.base), colors.to_linear(skin.tip), 0.8 * ripe)
    wave = np.cos(skin.stripes * around + 0.5 * coarse) + 0.35 * np.cos(
        (skin.stripes // 2) * around + 1.0
    )
    stripe = colors.smoothstep(0.35, 1.1, wave + 0.25 * fine)
    fade = colors.smoothstep(
        skin.stripe_reach + 0.1, skin.stripe_reach - 0.35, along + 0.05 * coarse
    )
    color = colors.mix(color, colors.to_linear(skin.stripe), skin.stripe_strength * stripe * fade)
    if skin.texture >= 0 and assets.skins:
        color *= _close_up(assets.skins[skin.texture % len(assets.skins)], coarse.shape, texel_m)
    return colors.scale_colors(color, 1 + skin.mottle * (fine + 0.7 * coarse))


def _close_up(picture: Pixels, shape: tuple[int, ...], texel_m: tuple[float, float]) -> Array32:
    # Mirrored in both directions to avoid seams; brightness and colour of the photo are removed.
    size = tuple(max(int(_TILE_M / m), 4) for m in reversed(texel_m))
    tile = colors.to_linear(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    tile /= cv2.GaussianBlur(tile, (0, 0), max(size[0] / 5, 1.0)) + np.float32(0.01)
    tile = np.clip(tile, 0.5, 2.0)
    # Orient the streaks along the fruit.
    grey = cv2.GaussianBlur(tile.mean(axis=2), (0, 0), max(size[0] / 40, 0.5))
    if np.abs(np.diff(grey, axis=0)).sum() > np.abs(np.diff(grey, axis=1)).sum():
        tile = tile.transpose(1, 0, 2)
    half = -(-shape[1] // 2)
    rows, columns = max(shape[0] - tile.shape[0], 0), max(half - tile.shape[1], 0)
    mirrored = np.pad(tile, ((0, rows), (0, columns), (0, 0)), "symmetric")[: shape[0], :half]
    return np.concatenate([mirrored, mirrored[:, ::-1]], axis=1)[:, : shape[1]]


def _warts(
    rng: Generator, skin: Skin, shape: tuple[int, int], texel_m: tuple[float, float]
) -> tuple[Array32, Array32]:
    rows, columns = shape
    area_cm2 = 1e4 * rows * columns * texel_m[0] * texel_m[1]
    spots = np.zeros(shape, np.float32)
    count = rng.poisson(skin.warts_per_cm2 * area_cm2)
    if count == 0:
        return spots, spots.copy()
    # Fewer warts near the neck.
    row = (rows * rng.beta(1.1, 1.5, count)).astype(int)
    np.add.at(spots, (row, rng.integers(columns, size=count)), rng.uniform(0.4, 1.0, count))
    radius_m = 0.0011 + 0.6 * skin.wart_m
    down, right = radius_m / texel_m[0], radius_m / texel_m[1]
    pad = min(int(3 * right) + 2, columns)
    padded = np.concatenate([spots[:, -pad:], spots, spots[:, :pad]], axis=1)
    padded = cv2.GaussianBlur(padded, (0, 0), sigmaX=max(right, 0.3), sigmaY=max(down, 0.3))
    peak = 2 * np.pi * max(right, 0.4) * max(down, 0.4)
    bumps = np.minimum(padded[:, pad:-pad] * peak, 1.2)
    return colors.smoothstep(0.25, 0.9, bumps), np.asarray(skin.wart_m * bumps)


def _ends(
    skin: Skin, color: Array32, from_blossom_m: NDArray[Any], length_m: float, noise: Array32
) -> Array32:
    # Blossom end: a corky scar in a pale ring. Stem end: a pale neck with a rim.
    size = np.clip(length_m / 0.2, 0.5, 1.1)
    from_tip_m = from_blossom_m + 0.0012 * noise
    color = colors.mix(
        color,
        colors.to_linear(skin.tip),
        0.7 * colors.smoothstep(0.014 * size, 0.004 * size, from_tip_m),
    )
    color = colors.mix(
        color,
        colors.to_linear((150, 128, 84)),
        0.85 * colors.smoothstep(0.0058, 0.0036, from_tip_m / size),
    )
    color = colors.mix(
        color,
        colors.to_linear((92, 70, 44)),
        0.8 * colors.smoothstep(0.0026, 0.0012, from_tip_m / size),
    )
    from_neck_m = length_m - from_blossom_m + 0.0015 * noise
    color = colors.scale_colors(
        color, 1 - 0.3 * colors.smoothstep(0.2 * length_m, 0.04 * length_m, from_neck_m)
    )
    pale = colors.to_linear((158, 182, 112))
    color = colors.mix(
        color, pale, skin.neck * colors.smoothstep(0.016 * size, 0.004 * size, from_neck_m)
    )
    return colors.mix(
        color,
        colors.to_linear((188, 196, 140)),
        0.7 * colors.smoothstep(0.0045, 0.0025, from_neck_m / size),
    )


def _slopes(height_m: Array32, row_m: float, column_m: float) -> tuple[Array32, Array32]:
    along = np.gradient(height_m, row_m, axis=0)
    around = (np.roll(height_m, -1, axis=1) - np.roll(height_m, 1, axis=1)) / (2 * column_m)
    return np.asarray(along), np.asarray(around)
