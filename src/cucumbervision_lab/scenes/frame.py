"""Render one labelled frame: scene, colour, simulated depth and ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cucumbervision.capture.frames import fuse_burst
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.tube.shape import arc_positions, points_along
from cucumbervision_lab.arrays import Array, Array32, Generator, Pixels
from cucumbervision_lab.scenes.appearance import Assets, Style, random_style
from cucumbervision_lab.scenes.colors import expose, palette, random_exposure
from cucumbervision_lab.scenes.compose import HARD, PLAIN, Composition, Setting, compose
from cucumbervision_lab.scenes.depth_camera import VGA, D4xx, sense
from cucumbervision_lab.scenes.scene import FruitTruth, render, truth_of
from cucumbervision_lab.scenes.shading import shade
from cucumbervision_lab.scenes.skin import Skin

_BURST = 3
_VGA_SHARE = 0.5  # of the frames with depth
_AXIS_POINTS = 41
# The focal length of a D435's colour camera is 0.71 of its width.
_FOCAL_SHARE = (0.69, 0.73)
# Carrot, banana, aubergine, wood, steel, a black hose, a white pipe; sRGB.
_DECOYS = palette("e27828 e8c846 3e2242 967654 96989c 28282a e1e0da")


@dataclass(frozen=True)
class FrameOptions:
    """Options shared by all frames of a set.

    Parameters
    ----------
    width, height : int
        Size of the pictures, pixels.
    shares : tuple of float
        Probabilities of hanging, bench and crate scenes; their sum is 1.
    depth : bool
        Also simulate the depth of a D435.
    scale_sd : float
        Standard deviation of the relative depth scale error; 0 for calibrated cameras.
    hard : bool
        Use `HARD` scenes instead of `PLAIN` ones.
    """

    width: int = 1280
    height: int = 720
    shares: tuple[float, float, float] = (0.6, 0.22, 0.18)
    depth: bool = True
    scale_sd: float = 0.0
    hard: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """A synthetic frame.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    camera : Intrinsics
        Intrinsics.
    staged : Composition
        The scene.
    truth : tuple of FruitTruth
        Ground truth of the cucumbers.
    exact_m : ndarray of float64, shape (H, W)
        Exact depth, metres; 0 for no object.
    depth_m : ndarray of float32, shape (H, W), optional
        Simulated depth of a D435 aligned to colour, fused from three frames, metres; 0 for no
        reading.
    depth_scale : float
        Ratio of simulated to exact depth.
    """

    color: Pixels
    camera: Intrinsics
    staged: Composition
    truth: tuple[FruitTruth, ...]
    exact_m: Array
    depth_m: Array32 | None
    depth_scale: float


def draw_frame(
    seed: int,
    index: int,
    options: FrameOptions,
    assets: Assets,
    restyle: Callable[[Style], Style] | None = None,
) -> Frame:
    """Render one frame of a set.

    Parameters
    ----------
    seed, index : int
        Seed of the set and index of the frame. A frame depends only on these and the options.
    options : FrameOptions
        Options of the set.
    assets : Assets
        Picture assets; may be empty.
    restyle : callable, optional
        Modifies the appearance before rendering, for example to simulate a particular greenhouse.

    Returns
    -------
    Frame
        Frame with 0 to 12 cucumbers, or 0 to 18 for `hard`.
    """
    # Separate random streams, so that the colour picture does not depend on `depth`.
    streams = np.random.default_rng([seed, index]).spawn(3)
    rng, painter, sensor = streams
    camera = _camera(rng, options)
    setting = list(Setting)[int(rng.choice(3, p=options.shares))]
    staged = compose(rng, camera, setting, HARD if options.hard else PLAIN)
    view = render(staged.scene, camera)
    style = _style(painter, staged, assets)
    if restyle is not None:
        style = restyle(style)
    linear = shade(staged.scene, view, camera, style, assets, painter)
    truth = truth_of(staged.scene, camera, view)
    exposure = random_exposure(painter, options.width)
    color = expose(linear, exposure, painter)
    scale = 1.0
    depth: Array32 | None = None
    if options.depth:
        scale = 1.0 + float(sensor.normal(0, options.scale_sd))
        size = VGA if sensor.random() < _VGA_SHARE else None
        reader = replace(D4xx.like(camera, size), scale_error=scale - 1.0)
        burst = sense(staged.scene, reader, sensor, _BURST)
        depth = fuse_burst([color] * _BURST, burst).depth_m
    return Frame(
        color,
        camera,
        staged,
        tuple(fruit for fruit, real in zip(truth, staged.cucumber, strict=True) if real),
        view.depth_m,
        depth,
        scale,
    )


def _camera(rng: Generator, options: FrameOptions) -> Intrinsics:
    focal = rng.uniform(*_FOCAL_SHARE) * max(options.width, options.height)
    centre = (
        options.width * (0.5 + rng.normal(0, 0.006)),
        options.height * (0.5 + rng.normal(0, 0.006)),
    )
    return Intrinsics(options.width, options.height, focal, focal, *centre)


def _style(rng: Generator, staged: Composition, assets: Assets) -> Style:
    style = random_style(
        rng,
        staged.scene,
        assets,
        staged.setting.value,
        leaf_roles=staged.leaf_roles,
        stem_roles=staged.stem_roles,
        up=staged.up,
    )
    skins = (
        skin if cucumber else _decoy(rng, skin)
        for skin, cucumber in zip(style.skins, staged.cucumber, strict=True)
    )
    return replace(style, skins=tuple(skins))


def _decoy(rng: Generator, skin: Skin) -> Skin:
    """Return the skin of a decoy, an object with the shape of a cucumber."""
    color = np.array(_DECOYS[int(rng.integers(len(_DECOYS)))]) * rng.uniform(0.8, 1.1)
    red, green, blue = np.clip(color + rng.normal(0, 8, 3), 0, 255).tolist()
    base = (red, green, blue)
    return replace(skin, base=base, tip=base, stripe=base, warts_per_cm2=0.0, neck=0.1, texture=-1)


def extras_of(truth: FruitTruth) -> dict[str, Any]:
    """Return the metric ground truth of a fruit for `Label.extras`.

    Parameters
    ----------
    truth : FruitTruth
        Ground truth of the fruit.

    Returns
    -------
    dict
        `centreline_m`, `thread_m`, `chord_m`, `distance_m` (depth of the midpoint), `tilt_deg`
        (angle between chord and picture plane), and `axis_m` with `radius_m` at 41 evenly spaced
        points of the axis from the blossom end, camera coordinates.

    Examples
    --------
    >>> from cucumbervision_lab.scenes.scene import Scene, truth_of
    >>> from cucumbervision_lab.scenes.bodies import arc_tube
    >>> tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.5))
    >>> truth, = truth_of(Scene((tube,)), Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0))
    >>> extras = extras_of(truth)
    >>> extras["distance_m"], extras["tilt_deg"], len(extras["axis_m"])
    (0.5, 0.0, 41)
    """
    axis = truth.axis_m
    run = arc_positions(axis)
    shares = np.linspace(0.0, 1.0, _AXIS_POINTS)
    even = points_along(axis, shares)
    lean = np.degrees(np.arcsin((axis[-1, 2] - axis[0, 2]) / truth.chord_m))
    return {
        "centreline_m": round(truth.centreline_m, 6),
        "thread_m": round(truth.thread_m, 6),
        "chord_m": round(truth.chord_m, 6),
        "distance_m": round(float(even[_AXIS_POINTS // 2, 2]), 5),
        "tilt_deg": round(float(abs(lean)), 3),
        "axis_m": even.round(5).tolist(),
        "radius_m": np.interp(shares * run[-1], run, truth.radius_m).round(6).tolist(),
    }
