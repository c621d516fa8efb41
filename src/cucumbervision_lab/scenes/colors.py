"""Linear colours and sRGB, smoothly varying colours, and the exposure of a colour camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cucumbervision_lab.arrays import Array32, Generator, Pixels

Grain = float | tuple[float, float]

Color = tuple[float, float, float]
"""sRGB, 0 to 255."""

_SRGB_LEVELS = 4096
_ROW = 1024  # OpenCV's remap does not accept rows of 32767 or more pixels


def palette(colors: str) -> tuple[Color, ...]:
    """Return the colours that are written in hexadecimal.

    Examples
    --------
    >>> palette("ff0000 102030")
    ((255.0, 0.0, 0.0), (16.0, 32.0, 48.0))
    """
    rgb = (bytes.fromhex(color) for color in colors.split())
    return tuple((float(red), float(green), float(blue)) for red, green, blue in rgb)


def to_linear(srgb: ArrayLike) -> Array32:
    """Convert sRGB (0 to 255) to linear RGB (0 to 1), IEC 61966-2-1.

    Examples
    --------
    >>> to_linear([0, 128, 255]).round(3).tolist()
    [0.0, 0.2160000056028366, 1.0]
    """
    values = np.asarray(srgb)
    if values.dtype == np.uint8:
        return np.asarray(_linear(np.arange(256, dtype=np.float32) / 255)[values])
    return _linear(values.astype(np.float32) / 255)


def _linear(c: NDArray[Any]) -> Array32:
    bent = ((np.maximum(c, 0) + 0.055) / 1.055) ** 2.4
    return np.where(c <= 0.04045, c / 12.92, bent).astype(np.float32)


def to_srgb(linear: Array32) -> Pixels:
    """Convert linear RGB, clipped to 0 to 1, to sRGB.

    Parameters
    ----------
    linear : ndarray of float32
        Any shape.

    Returns
    -------
    ndarray of uint8
        0 to 255, the same shape.

    Examples
    --------
    >>> to_srgb(np.array([-1.0, 0.0, 0.216, 1.0, 9.0], np.float32)).tolist()
    [0, 0, 128, 255, 255]
    """
    light = np.arange(_SRGB_LEVELS) / (_SRGB_LEVELS - 1)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    table = np.rint(255 * curve).astype(np.uint8)
    level = np.clip(linear * np.float32(_SRGB_LEVELS - 1) + np.float32(0.5), 0, _SRGB_LEVELS - 1)
    return np.asarray(table[level.astype(np.uint16)])


def mix(a: ArrayLike, b: ArrayLike, share: Array32) -> Array32:
    """Interpolate between two colours: `a` for a share of 0, `b` for 1.

    Parameters
    ----------
    a, b : array_like
        A single colour, shape (3,), or one per element, shape (..., 3).
    share : ndarray of float32, shape (...)
        0 to 1.

    Returns
    -------
    ndarray of float32, shape (..., 3)

    Examples
    --------
    >>> mix((0, 0, 0), (4, 4, 8), np.array([0.0, 0.5], np.float32)).tolist()
    [[0.0, 0.0, 0.0], [2.0, 2.0, 4.0]]
    """
    return _spread(a, 1 - share) + _spread(b, share)


def _spread(color: ArrayLike, weight: Array32) -> Array32:
    values = np.asarray(color, np.float32)
    if values.ndim > 1:
        return scale_colors(values, weight)
    return np.asarray(weight.reshape(-1, 1) @ values[None]).reshape(*weight.shape, 3)


def scale_colors(picture: Array32, factor: NDArray[Any]) -> Array32:
    """Multiply colours of shape (..., 3) by factors of shape (...).

    Examples
    --------
    >>> scale_colors(np.ones((1, 3), np.float32), np.array([0.5], np.float32)).tolist()
    [[0.5, 0.5, 0.5]]
    """
    # Broadcasting over an axis of length 3 is five times slower in NumPy.
    flat = factor.reshape(-1, 1)
    threefold = cv2.merge([flat, flat, flat]).reshape(picture.shape)
    return np.asarray(picture * threefold)


def smoothstep(low: float, high: float, x: Any) -> Array32:
    """Return the smoothstep function, 0 at `low` and 1 at `high`; decreasing if `high < low`.

    Examples
    --------
    >>> smoothstep(0.0, 2.0, np.array([-1.0, 1.0, 3.0])).tolist()
    [0.0, 0.5, 1.0]
    """
    t = np.clip((np.asarray(x, np.float32) - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def jitter(rng: Generator, color: ArrayLike, spread: float = 0.12) -> Color:
    """Sample a colour near another by random factors on brightness and channels.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    color : array_like, shape (3,)
        sRGB, 0 to 255.
    spread : float
        Standard deviation of the brightness factor; that of each channel is a third of it.
    """
    factor = 1 + spread * rng.standard_normal() + spread / 3 * rng.standard_normal(3)
    red, green, blue = np.clip(np.asarray(color, float) * factor, 2, 253).tolist()
    return red, green, blue


def smooth_noise(
    rng: Generator, shape: tuple[int, int], grain_px: Grain, *, wrap: bool = False
) -> Array32:
    """Generate smooth noise with mean 0 and a standard deviation of about 0.7.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    shape : tuple of int
        Rows and columns.
    grain_px : float or tuple of float
        Grain size in pixels, for both directions or as (vertical, horizontal).
    wrap : bool
        Make the noise periodic in both directions.

    Returns
    -------
    ndarray of float32, shape `shape`
    """
    down, right = (grain_px, grain_px) if isinstance(grain_px, int | float) else grain_px
    rows = max(int(np.ceil(shape[0] / max(down, 1.0))), 2)
    columns = max(int(np.ceil(shape[1] / max(right, 1.0))), 2)
    small = rng.standard_normal((rows, columns), dtype=np.float32)
    if not wrap:
        return np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_CUBIC))
    y = (np.arange(shape[0], dtype=np.float32) + 0.5) * rows / shape[0] - 0.5
    x = (np.arange(shape[1], dtype=np.float32) + 0.5) * columns / shape[1] - 0.5
    across, along = np.meshgrid(x, y)
    noise = cv2.remap(small, across, along, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    return np.asarray(noise)


def sample(texture: Array32, x_px: Array32, y_px: Array32) -> Array32:
    """Interpolate a periodic texture at subpixel positions.

    Parameters
    ----------
    texture : ndarray of float32, shape (H, W) or (H, W, C)
        Texture with at most 4 channels.
    x_px, y_px : ndarray of float32, shape (N,)
        Column and row positions.

    Returns
    -------
    ndarray of float32, shape (N,) or (N, C)

    Examples
    --------
    >>> row = np.array([[0.0, 2.0]], np.float32)
    >>> sample(row, np.array([0.5, 1.5], np.float32), np.zeros(2, np.float32)).tolist()
    [1.0, 1.0]
    """
    count = len(x_px)
    size = -(-count // _ROW) * _ROW
    x, y = (np.zeros(size, np.float32) for _ in range(2))
    x[:count], y[:count] = x_px, y_px
    colors = cv2.remap(
        texture,
        x.reshape(-1, _ROW),
        y.reshape(-1, _ROW),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    return np.asarray(colors.reshape(size, *texture.shape[2:])[:count])


_KEY = 0.20  # mean brightness that automatic exposure aims at


@dataclass(frozen=True)
class Exposure:
    """Settings and imperfections of a colour camera.

    Parameters
    ----------
    highlights : float
        Maximum brightness of highlights after metering; saturation is 1.
    stops : float
        Exposure error in stops.
    warmth, tint : float
        Error of the white balance: red over blue, green over both.
    contrast : float
        Exponent of the tone curve about middle grey; above 1 increases contrast.
    saturation : float
        1 leaves colours as they are.
    blur_px : float
        Standard deviation of the lens blur.
    motion_px, motion_deg : float
        Length and direction of motion blur.
    shot, read : float
        Shot noise (variance per brightness) and read noise (standard deviation); saturation is 1.
    vignette : float
        Relative loss of brightness in the corners.
    sharpen : float
        Strength of in-camera sharpening.
    quality : int
        JPEG quality, 1 to 100; 0 for no compression.
    """

    highlights: float = 1.5
    stops: float = 0.0
    warmth: float = 0.0
    tint: float = 0.0
    contrast: float = 1.0
    saturation: float = 1.0
    blur_px: float = 0.6
    motion_px: float = 0.0
    motion_deg: float = 0.0
    shot: float = 0.0004
    read: float = 0.002
    vignette: float = 0.1
    sharpen: float = 0.3
    quality: int = 92


def random_exposure(rng: Generator, width: int = 1280) -> Exposure:
    """Sample camera settings: mostly good, some dark, bright, blurred or noisy.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    width : int
        Width of the picture, pixels; blur is scaled with it.

    Examples
    --------
    >>> 25 <= random_exposure(np.random.default_rng(1)).quality <= 98
    True
    """
    scale = width / 1280
    moved = rng.random() < 0.25
    dark = float(rng.beta(1.2, 5.0))
    return Exposure(
        highlights=float(np.exp(rng.uniform(0.0, 1.5))),
        stops=float(rng.normal(0.15, 0.8)),
        warmth=float(rng.normal(0, 0.10)),
        tint=float(rng.normal(0, 0.04)),
        contrast=float(rng.uniform(0.8, 1.5)),
        saturation=float(rng.uniform(0.75, 1.55)),
        blur_px=float(rng.uniform(0.35, 0.6) + scale * rng.gamma(1.2, 0.4)),
        motion_px=float(scale * rng.uniform(2.0, 15.0)) if moved else 0.0,
        motion_deg=float(rng.uniform(0, 180)),
        shot=0.0001 + 0.02 * dark,
        read=0.0005 + 0.008 * dark,
        vignette=float(rng.uniform(0.0, 0.35)),
        sharpen=float(rng.choice([0.0, rng.uniform(0.2, 0.7)])),
        quality=int(rng.integers(25, 99)),
    )


def expose(linear: Array32, exposure: Exposure, rng: Generator) -> Pixels:
    """Simulate a picture of the colour camera.

    Parameters
    ----------
    linear : ndarray of float32, shape (H, W, 3)
        Linear RGB of any scale; exposure is automatic.
    exposure : Exposure
        Camera settings.
    rng : numpy.random.Generator
        Random generator for noise.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB.

    Examples
    --------
    >>> grey = np.full((32, 32, 3), 7.0, np.float32)
    >>> clean = Exposure(shot=0.0, read=0.0, vignette=0.0, quality=0)
    >>> picture = expose(grey, clean, np.random.default_rng(1))
    >>> picture.shape, picture.dtype.name, int(picture[16, 16, 0])
    ((32, 32, 3), 'uint8', 124)
    """
    light = _blurred(_apply_exposure(linear, exposure), exposure)
    light = _add_noise(light, exposure, rng)
    picture: NDArray[Any] = to_srgb(_apply_tone_curve(light, exposure))
    if exposure.sharpen > 0:
        soft = cv2.GaussianBlur(picture, (0, 0), 1.0)
        picture = cv2.addWeighted(picture, 1 + exposure.sharpen, soft, -exposure.sharpen, 0)
    if exposure.quality > 0:
        picture = _compressed(np.asarray(picture, np.uint8), exposure.quality)
    return np.asarray(picture, np.uint8)


def _apply_exposure(linear: Array32, exposure: Exposure) -> Array32:
    few = linear[::8, ::8].reshape(-1, 3) @ np.array([0.25, 0.6, 0.15], np.float32)
    mean = float(np.minimum(few, 8 * np.median(few) + 1e-6).mean())
    bright = float(np.quantile(few, 0.998))  # a fruit may be all that is lit
    gain = (
        min(_KEY / max(mean, 1e-6), exposure.highlights / max(bright, 1e-6)) * 2.0**exposure.stops
    )
    white = np.array([1 + exposure.warmth, 1 + exposure.tint, 1 - exposure.warmth], np.float32)
    light = linear * (np.float32(gain) * np.clip(white, 0.4, 2.5))
    if exposure.vignette > 0:
        height, width = linear.shape[:2]
        x = np.linspace(-1, 1, width, dtype=np.float32) ** 2
        y = np.linspace(-1, 1, height, dtype=np.float32)[:, None] ** 2
        light *= (1 - np.float32(exposure.vignette / 2) * (x + y))[..., None]
    return np.asarray(np.minimum(light, 6.0))


def _blurred(light: Array32, exposure: Exposure) -> Array32:
    if exposure.blur_px > 0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), exposure.blur_px))
    if exposure.motion_px > 1:
        light = np.asarray(cv2.filter2D(light, -1, _path(exposure)))
    return light


def _path(exposure: Exposure) -> Array32:
    half = int(np.ceil(exposure.motion_px / 2))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    turn = np.deg2rad(exposure.motion_deg)
    for offset in np.linspace(-0.5, 0.5, 4 * half + 1) * exposure.motion_px:
        x, y = half + offset * np.cos(turn), half + offset * np.sin(turn)
        kernel[int(np.rint(y)), int(np.rint(x))] += 1
    return np.asarray(kernel / kernel.sum())


def _add_noise(light: Array32, exposure: Exposure, rng: Generator) -> Array32:
    if exposure.shot == 0 and exposure.read == 0:
        return light
    height, width = light.shape[:2]
    green: NDArray[Any] = rng.standard_normal((height, width), dtype=np.float32)
    green = cv2.GaussianBlur(green, (0, 0), 0.5)
    # In a Bayer pattern, a quarter of the pixels are red and a quarter blue: interpolate them.
    half = rng.standard_normal((2, -(-height // 2), -(-width // 2)), dtype=np.float32)
    red, blue = (cv2.resize(n, (width, height), interpolation=cv2.INTER_LINEAR) for n in half)
    spread = np.sqrt(np.float32(exposure.shot) * light + np.float32(exposure.read**2))
    return np.asarray(light + spread * np.dstack([1.4 * red, 1.3 * green, 1.6 * blue]))


def _apply_tone_curve(light: Array32, exposure: Exposure) -> Array32:
    # Highlights are compressed before clipping.
    light = np.maximum(light, 0)
    grey = light @ np.array([0.25, 0.6, 0.15], np.float32)
    light = grey[..., None] + np.float32(exposure.saturation) * (light - grey[..., None])
    if exposure.contrast != 1:
        lift = np.power(np.maximum(grey, 1e-4) / 0.2, np.float32(exposure.contrast - 1))
        light *= np.clip(lift, 0.25, 2.5)[..., None]
    over = np.maximum(light - 0.7, 0)
    return np.asarray(np.minimum(light, 0.7) + 0.3 * over / (over + 0.3))


def _compressed(picture: Pixels, quality: int) -> Pixels:
    _, packed = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    unpacked: NDArray[Any] | None = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    return picture if unpacked is None else np.ascontiguousarray(unpacked[..., ::-1], np.uint8)
