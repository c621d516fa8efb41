"""Simulate a colour camera: exposure, blur, noise, tone curve and compression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision_lab.arrays import Array32, Generator, Pixels
from cucumbervision_lab.scenes.colors import to_srgb

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
