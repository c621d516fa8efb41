"""Lighting of a scene: environment, sun, ambient occlusion and cast shadows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision_lab.arrays import Array, Array32, Generator
from cucumbervision_lab.scenes.colors import sample, smooth_noise, smoothstep, to_linear

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision_lab.scenes.textures import Assets

Vector = tuple[float, float, float]

_SKY_SHAPE = (32, 64)

_MAP = 96

_SUN_PEAK = 25.0  # times the mean; brighter pixels are the sun, which is modelled separately


@dataclass(frozen=True)
class Light:
    """Light sources, normalised so that white matt ground without sun has a radiance of 1.

    Parameters
    ----------
    sun : tuple of float
        Unit vector towards the sun, camera coordinates.
    sun_color : tuple of float
        Linear RGB of mean 1.
    sun_strength : float
        Radiance of white matt ground that faces the sun.
    up : tuple of float
        Unit vector, camera coordinates.
    yaw_deg : float
        Rotation of the environment about `up`.
    environment : int
        Index among the assets; -1 for a generated sky.
    zenith, horizon, ground : tuple of float
        sRGB of a generated sky, 0 to 255.
    panels : int
        Number of bright panes in a generated sky.
    shade : float
        Strength of dappled shade by leaves outside the view, 0 to 1.
    spot_m : float
        Size of the spots of dappled shade, metres.
    """

    sun: Vector
    sun_color: Vector = (1.0, 1.0, 1.0)
    sun_strength: float = 0.0
    up: Vector = (0.0, -1.0, 0.0)
    yaw_deg: float = 0.0
    environment: int = -1
    zenith: Vector = (235.0, 240.0, 250.0)
    horizon: Vector = (150.0, 165.0, 150.0)
    ground: Vector = (60.0, 80.0, 50.0)
    panels: int = 3
    shade: float = 0.0
    spot_m: float = 0.06


@dataclass(frozen=True, eq=False)
class LightMaps:
    """Light as a function of the surface normal.

    Parameters
    ----------
    front, back : ndarray of float32, shape (S, S, 3)
        Diffuse radiance of a white matt surface with normal (x, y), and with the opposite normal;
        x and y range from -1 to 1 over columns and rows.
    sharp, soft : ndarray of float32, shape (S, S, 3)
        Specular reflection for that normal, glossy and dull.
    """

    front: Array32
    back: Array32
    sharp: Array32
    soft: Array32


def random_light(rng: Generator, assets: Assets, up: Vector = (0.0, -1.0, 0.0)) -> Light:
    """Sample a light: overcast, under glass, sunny, under lamps or inside the canopy.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    assets : Assets
        Environments, used with a probability of 0.5 if available.
    up : tuple of float
        Unit vector, camera coordinates.
    """
    zenith = np.asarray(up, float)
    # Mostly from above and from the side of the camera.
    towards = 1.2 * zenith + rng.normal(0, 0.6, 3) + np.array([0.0, 0.0, -0.35])
    towards /= np.linalg.norm(towards)
    sunny = rng.random() < 0.55
    warm = rng.uniform(-0.08, 0.30)
    hue = np.array([1 + 0.6 * warm, 1.0, 1 - warm])
    sky = float(rng.uniform(185, 255))
    tint = rng.normal(0, 6, 3)
    side = rng.choice([70.0, 120.0, 190.0]) + rng.normal(0, 10, 3) + np.array([-8.0, 8.0, -14.0])
    below = rng.choice([35.0, 75.0, 150.0]) + rng.normal(0, 8, 3) + np.array([-4.0, 10.0, -12.0])
    taken = bool(assets.environments) and rng.random() < 0.5
    return Light(
        sun=_triple(towards),
        sun_color=_triple(hue / hue.mean()),
        sun_strength=float(rng.uniform(0.5, 4.0)) if sunny else 0.0,
        up=_triple(zenith),
        yaw_deg=float(rng.uniform(0, 360)),
        environment=int(rng.integers(len(assets.environments))) if taken else -1,
        zenith=_triple(np.clip(sky + tint, 60, 255)),
        horizon=_triple(np.clip(side, 10, 255)),
        ground=_triple(np.clip(below, 10, 255)),
        panels=int(rng.integers(0, 6)),
        shade=float(rng.choice([0.0, rng.uniform(0.3, 1.0)])),
        spot_m=float(rng.uniform(0.03, 0.14)),
    )


def sky_map(rng: Generator, light: Light, assets: Assets) -> tuple[Array32, Array]:
    """Return the environment of a light, and its directions.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator, for a generated sky.
    light : Light
        The light; its sun is not included.
    assets : Assets
        Assets that `light.environment` refers to.

    Returns
    -------
    sky : ndarray of float32, shape (H, W, 3)
        Radiance, equirectangular, the top row up; white matt ground under it has a radiance of 1.
    frame : ndarray of float64, shape (3, 3)
        Rows: right, forward and up of the environment, in camera coordinates.
    """
    if light.environment >= 0 and assets.environments:
        sky = assets.environments[light.environment % len(assets.environments)]
        sky = np.minimum(sky, _SUN_PEAK * sky.mean())
        # Automatic white balance removes most of the sky's colour.
        sky = 0.6 * sky + 0.4 * sky.mean(axis=2, keepdims=True)
    else:
        sky = _drawn_sky(rng, light)
    level = float(irradiance(harmonics(sky), np.array([[0.0, 0.0, 1.0]])).mean()) / np.pi
    return np.asarray(sky / level, np.float32), _world(light)


def _triple(values: Array) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z


def light_maps(rng: Generator, light: Light, assets: Assets) -> LightMaps:
    """Compute the light maps of a light.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator, for a generated sky.
    light : Light
        Light; its sun is not included in the maps.
    assets : Assets
        Assets that `light.environment` refers to.
    """
    sky, frame = sky_map(rng, light, assets)
    nine = harmonics(sky)
    line = (np.arange(_MAP, dtype=np.float32) + 0.5) * (2 / _MAP) - 1
    x, y = np.meshgrid(line, line)
    radius = np.maximum(np.hypot(x, y), 1.0)
    x, y = x / radius, y / radius
    normal = np.stack([x, y, -np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=-1)
    # Reflected viewing direction: 2 (n . v) n - v with v = (0, 0, -1).
    mirrored = -2 * normal[..., 2:] * normal - np.array([0.0, 0.0, -1.0])
    flat = (normal @ frame.T).reshape(-1, 3)
    shape = (_MAP, _MAP, 3)
    front = np.maximum(irradiance(nine, flat) / np.pi, 0.02).reshape(shape)
    back_light = np.maximum(irradiance(nine, -flat) / np.pi, 0.02).reshape(shape)
    towards = mirrored @ frame.T
    return LightMaps(
        front.astype(np.float32),
        back_light.astype(np.float32),
        _seen(sky, towards, 1.0),
        _seen(sky, towards, 5.0),
    )


def _world(light: Light) -> Array:
    # Rows: right, forward and up of the environment, in camera coordinates.
    up = np.asarray(light.up, float)
    aside = np.cross(up, (0.0, 0.0, 1.0) if abs(up[2]) < 0.9 else (1.0, 0.0, 0.0))
    aside /= np.linalg.norm(aside)
    ahead = np.cross(up, aside)
    cos, sin = np.cos(np.deg2rad(light.yaw_deg)), np.sin(np.deg2rad(light.yaw_deg))
    return np.stack([cos * aside + sin * ahead, cos * ahead - sin * aside, up])


def _drawn_sky(rng: Generator, light: Light) -> Array32:
    rows, columns = _SKY_SHAPE
    height = np.sin(np.pi * (0.5 - (np.arange(rows, dtype=np.float32) + 0.5) / rows))[:, None, None]
    zenith, horizon, ground = (to_linear(c) for c in (light.zenith, light.horizon, light.ground))
    sky = np.where(
        height > 0,
        horizon + np.maximum(height, 0) ** 0.7 * (zenith - horizon),
        horizon + np.minimum(-6 * height, 1) * (ground - horizon),
    )
    sky = np.repeat(sky, columns, axis=1).astype(np.float32)
    for _ in range(light.panels):
        top, column = int(rng.integers(1, rows // 2)), int(rng.integers(columns))
        tall, width = int(rng.integers(2, 9)), int(rng.integers(3, 16))
        columns_lit = np.arange(column, column + width) % columns
        sky[top : top + tall, columns_lit] *= np.float32(rng.choice([0.25, 2.5, 5.0]))
    return sky


def _basis(d: Array) -> Array:
    x, y, z = d[:, 0], d[:, 1], d[:, 2]
    return np.stack(
        [
            np.full(len(d), 0.282095),
            0.488603 * y,
            0.488603 * z,
            0.488603 * x,
            1.092548 * x * y,
            1.092548 * y * z,
            0.315392 * (3 * z * z - 1),
            1.092548 * x * z,
            0.546274 * (x * x - y * y),
        ],
        axis=1,
    )


def harmonics(environment: Array32) -> Array:
    """Return the nine spherical harmonic coefficients of an environment.

    Parameters
    ----------
    environment : ndarray of float32, shape (H, W, 3)
        Radiance, equirectangular, the top row up (z).

    Returns
    -------
    ndarray of float64, shape (9, 3)

    Examples
    --------
    A uniform radiance of 1 gives an irradiance of pi:

    >>> nine = harmonics(np.ones((32, 64, 3), np.float32))
    >>> irradiance(nine, np.array([[0.0, 0.0, 1.0]])).round(2).tolist()
    [[3.14, 3.14, 3.14]]
    """
    rows, columns = environment.shape[:2]
    polar_angles = np.pi * ((np.arange(rows) + 0.5) / rows)
    azimuths = 2 * np.pi * ((np.arange(columns) + 0.5) / columns)
    polar, azimuth = np.meshgrid(polar_angles, azimuths, indexing="ij")
    direction = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    solid_angle = np.sin(polar) * (np.pi / rows) * (2 * np.pi / columns)
    weighted = environment.reshape(-1, 3).astype(np.float64) * solid_angle.reshape(-1, 1)
    return np.asarray(_basis(direction.reshape(-1, 3)).T @ weighted)


def irradiance(nine: Array, normal: Array) -> Array:
    """Return the irradiance for given normals (Ramamoorthi and Hanrahan 2001, equation 6).

    Parameters
    ----------
    nine : ndarray of float64, shape (9, 3)
        Coefficients from `harmonics`.
    normal : ndarray of float64, shape (N, 3)
        Unit vectors, z up.

    Returns
    -------
    ndarray of float64, shape (N, 3)
    """
    spread = np.pi * np.array([1.0, *[2 / 3] * 3, *[1 / 4] * 5])
    return np.asarray(_basis(normal) @ (spread[:, None] * nine))


def _seen(sky: Array32, towards: Array, blur_share: float) -> Array32:
    rows, columns = sky.shape[:2]
    sigma = blur_share * columns / 64
    pad = columns // 4
    padded = np.concatenate([sky[:, -pad:], sky, sky[:, :pad]], axis=1).astype(np.float32)
    soft = cv2.GaussianBlur(padded, (0, 0), sigma)
    azimuth = np.arctan2(towards[..., 1], towards[..., 0]) / (2 * np.pi) % 1.0
    polar = np.arccos(np.clip(towards[..., 2], -1, 1)) / np.pi
    x, y = azimuth * columns - 0.5 + pad, polar * rows - 0.5
    colors = cv2.remap(
        soft,
        x.astype(np.float32),
        y.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(colors)


_WIDE = 320  # pixels of the small picture

_STEPS = 14

_REACH_M = 0.40

_TILE = 256

# Downsampled pixels on an outline would cause a bright rim around foreground objects: take the
# minimum of the neighbours.
_AROUND = np.ones((3, 3), np.uint8)


def _small(depth_m: Array32) -> tuple[int, Array32]:
    step = max(round(depth_m.shape[1] / _WIDE), 1)
    return step, np.ascontiguousarray(depth_m[::step, ::step])


def _points(depth_m: Array32, step: int, camera: Intrinsics) -> tuple[Array32, Array32]:
    rows, columns = depth_m.shape
    x = ((step * np.arange(columns) - camera.cx_px) / camera.fx_px).astype(np.float32)
    y = ((step * np.arange(rows) - camera.cy_px) / camera.fy_px).astype(np.float32)
    return x * depth_m, y[:, None] * depth_m


def _grown(small: NDArray[Any], shape: tuple[int, ...], step: int) -> Array32:
    grown = cv2.resize(
        small, (small.shape[1] * step, small.shape[0] * step), interpolation=cv2.INTER_LINEAR
    )
    return np.asarray(grown[: shape[0], : shape[1]])


def sun_shadow(rng: Generator, depth_m: Array32, camera: Intrinsics, light: Light) -> Array32:
    """Compute the share of sunlight at each pixel from the visible depth.

    Marches from each point towards the sun in screen space. A step that lies slightly behind the
    visible surface counts as shadowed.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator; steps are jittered for soft edges.
    depth_m : ndarray of float32, shape (H, W)
        Depth in metres, large for no object.
    camera : Intrinsics
        The camera; distortion is ignored.
    light : Light
        Light with the sun.

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


def dappled_shade(rng: Generator, depth_m: Array32, camera: Intrinsics, light: Light) -> Array32:
    """Compute the share of sunlight that passes leaves outside the picture.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    depth_m : ndarray of float32, shape (H, W)
        Metres.
    camera : Intrinsics
        The camera.
    light : Light
        Light with the sun's direction, `shade` and `spot_m`.

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
    across = np.cross(sun, aside)
    scale = 16.0 / light.spot_m
    u, v = (
        (scale * (a[0] * x + a[1] * y + a[2] * small)).astype(np.float32).ravel() % _TILE
        for a in (aside, across)
    )
    tile = smooth_noise(rng, (_TILE, _TILE), 16, wrap=True)
    tile += 0.5 * smooth_noise(rng, (_TILE, _TILE), 7, wrap=True)
    level = rng.uniform(-0.5, 0.6)
    through = smoothstep(level - 0.12, level + 0.12, sample(tile, u, v)).reshape(small.shape)
    return 1 - np.float32(light.shade) * (1 - _grown(through, depth_m.shape, step))


def ambient_occlusion(depth_m: Array32) -> Array32:
    """Compute the ambient occlusion of each pixel from the surrounding depth.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres.

    Returns
    -------
    ndarray of float32, shape (H, W)
        Above 0 (enclosed) to 1 (open).

    Notes
    -----
    Unsharp masking of the depth (Luft, Colditz and Deussen, SIGGRAPH 2006), at three scales, on
    1 / depth so that what is far stays far.
    """
    step, small = _small(depth_m)
    inverse = 1 / small
    closed = np.zeros(small.shape, np.float32)
    for sigma, weight in ((2.5, 0.4), (7.0, 0.35), (18.0, 0.25)):
        around = cv2.GaussianBlur(inverse, (0, 0), sigma)
        before = np.maximum(around - inverse, 0) * small
        # Objects far in front occlude little of the light.
        closed += weight * before / (before + 0.010) * 0.08 / (before + 0.08)
    opened = 1 - np.float32(0.95) * closed
    return _grown(cv2.erode(opened, _AROUND), depth_m.shape, step)
