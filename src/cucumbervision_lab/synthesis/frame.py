"""One labelled picture: the scene, its colours, what a D435 reads of it, and the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import fuse_burst
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.geometry.curve import arc_positions, points_along
from cucumbervision_lab.synthesis.appearance import random_style
from cucumbervision_lab.synthesis.color_camera import expose, random_exposure
from cucumbervision_lab.synthesis.compose import HARD, PLAIN, Composition, Setting, compose
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.scene import render, truth_of
from cucumbervision_lab.synthesis.shading import shade

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from cucumbervision_lab.synthesis.appearance import Assets, Style
    from cucumbervision_lab.synthesis.bodies import Tube
    from cucumbervision_lab.synthesis.scene import FruitTruth
    from cucumbervision_lab.synthesis.skin import Skin

_BURST = 3
_AXIS_POINTS = 41
# A D435's colour camera has a focal length of 0.71 of its width.
_FOCAL_SHARE = (0.69, 0.73)
# Carrot, banana, aubergine, wood, steel, a black hose, a white pipe; sRGB.
_DECOYS = (
    (226, 120, 40),
    (232, 200, 70),
    (62, 34, 66),
    (150, 118, 84),
    (150, 152, 156),
    (40, 40, 42),
    (225, 224, 218),
)


@dataclass(frozen=True)
class FrameOptions:
    """What every frame of a set has in common.

    Parameters
    ----------
    width, height : int
        Of the pictures, pixels.
    shares : tuple of float
        How often a frame shows fruit hanging, on a bench, in a crate; they sum to 1.
    depth : bool
        Whether a D435 reads depth too.
    scale_sd : float
        Standard deviation of each camera's own error of depth scale, as a share; 0 for
        calibrated cameras.
    hard : bool
        Whether fruit are smaller, larger, more crowded and more hidden than those tested by.
    """

    width: int = 1280
    height: int = 720
    shares: tuple[float, float, float] = (0.6, 0.22, 0.18)
    depth: bool = True
    scale_sd: float = 0.0
    hard: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """A drawn frame.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    camera : Intrinsics
        Who looked.
    staged : Composition
        The scene.
    truth : tuple of FruitTruth
        Of its cucumbers, in the order of `bodies`.
    bodies : tuple of Tube
        The cucumbers.
    exact_m : ndarray of float64, shape (H, W)
        Depth as it is, metres; 0 where nothing is.
    depth_m : ndarray of float32, shape (H, W), optional
        Depth as a D435 reads it, aligned to colour, a burst of three fused, metres; 0 where there
        is no reading.
    depth_scale : float
        What that camera reads over what is.
    """

    color: NDArray[np.uint8]
    camera: Intrinsics
    staged: Composition
    truth: tuple[FruitTruth, ...]
    bodies: tuple[Tube, ...]
    exact_m: NDArray[np.float64]
    depth_m: NDArray[np.float32] | None
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
        Of the set, and the frame's number in it: the same pair gives the same frame, whatever
        else is drawn.
    options : FrameOptions
        What all frames have in common.
    assets : Assets
        Textures, backgrounds and lights; may be empty.
    restyle : callable, optional
        Changes the frame's look before it is painted: a house with skins or light of its own.

    Returns
    -------
    Frame
        With 0 to 12 cucumbers, 0 to 18 if they are to be hard to find.
    """
    # Colour and depth draw from streams of their own: a frame with depth looks as one without.
    streams = np.random.default_rng([seed, index]).spawn(3)
    rng, painter, sensor = streams
    camera = _camera(rng, options)
    setting = list(Setting)[int(rng.choice(3, p=options.shares))]
    staged = compose(rng, camera, setting, HARD if options.hard else PLAIN)
    view = render(staged.scene, camera)
    truth = truth_of(staged.scene, camera, view)
    style = _style(painter, staged, assets)
    if restyle is not None:
        style = restyle(style)
    linear = shade(staged.scene, view, camera, style, assets, painter)
    exposure = random_exposure(painter, options.width)
    color = expose(linear, exposure, painter, view.depth_m)
    scale = 1.0
    depth: NDArray[np.float32] | None = None
    if options.depth:
        scale = 1.0 + float(sensor.normal(0, options.scale_sd))
        reader = replace(D4xx.like(camera), scale_error=scale - 1.0)
        burst = sense(staged.scene, reader, sensor, _BURST)
        depth = fuse_burst([color] * _BURST, burst).depth_m
    real = [k for k, cucumber in enumerate(staged.cucumber) if cucumber]
    return Frame(
        color,
        camera,
        staged,
        tuple(truth[k] for k in real),
        tuple(staged.scene.fruit[k] for k in real),
        view.depth_m,
        depth,
        scale,
    )


def _camera(rng: np.random.Generator, options: FrameOptions) -> Intrinsics:
    focal = rng.uniform(*_FOCAL_SHARE) * max(options.width, options.height)
    centre = (
        options.width * (0.5 + rng.normal(0, 0.006)),
        options.height * (0.5 + rng.normal(0, 0.006)),
    )
    return Intrinsics(options.width, options.height, focal, focal, *centre)


def _style(rng: np.random.Generator, staged: Composition, assets: Assets) -> Style:
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


def _decoy(rng: np.random.Generator, skin: Skin) -> Skin:
    """Return the skin of something that has a cucumber's shape only."""
    color = np.array(_DECOYS[int(rng.integers(len(_DECOYS)))]) * rng.uniform(0.8, 1.1)
    red, green, blue = np.clip(color + rng.normal(0, 8, 3), 0, 255).tolist()
    base = (red, green, blue)
    return replace(skin, base=base, tip=base, stripe=base, warts_per_cm2=0.0, neck=0.1, texture=-1)


def extras_of(body: Tube, truth: FruitTruth) -> dict[str, Any]:
    """Return a fruit's metric truth as plain numbers, to be written beside its label.

    Parameters
    ----------
    body : Tube
        The fruit, camera coordinates.
    truth : FruitTruth
        What is known of it.

    Returns
    -------
    dict
        `centreline_m`, `thread_m`, `chord_m`, `distance_m` (depth of its middle), `tilt_deg` (of
        its chord out of the picture plane), and `axis_m` with `radius_m` at 41 points evenly
        along the axis, blossom end first, camera coordinates.

    Examples
    --------
    >>> from cucumbervision_lab.synthesis.scene import Scene, truth_of
    >>> from cucumbervision_lab.synthesis.bodies import arc_tube
    >>> tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.5))
    >>> truth, = truth_of(Scene((tube,)), Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0))
    >>> extras = extras_of(tube, truth)
    >>> extras["distance_m"], extras["tilt_deg"], len(extras["axis_m"])
    (0.5, 0.0, 41)
    """
    axis = truth.axis_m
    run = arc_positions(axis)
    shares = np.linspace(0.0, 1.0, _AXIS_POINTS)
    even = points_along(axis, shares)
    blossom, stem = body.poles_m
    lean = np.degrees(np.arcsin((stem[2] - blossom[2]) / truth.chord_m))
    return {
        "centreline_m": round(truth.centreline_m, 6),
        "thread_m": round(truth.thread_m, 6),
        "chord_m": round(truth.chord_m, 6),
        "distance_m": round(float(even[_AXIS_POINTS // 2, 2]), 5),
        "tilt_deg": round(float(abs(lean)), 3),
        "axis_m": even.round(5).tolist(),
        "radius_m": np.interp(shares * run[-1], run, truth.radius_m).round(6).tolist(),
    }
