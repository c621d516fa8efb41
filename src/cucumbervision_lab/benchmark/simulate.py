"""Draw one case of the benchmark: the scene, and what a D435 makes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.frames import Capture, fuse_burst
from cucumbervision_lab.benchmark.protocol import CAMERA, Case
from cucumbervision_lab.synthesis.appearance import Assets, random_style
from cucumbervision_lab.synthesis.bodies import Tube, random_fruit, rotation, variety_of
from cucumbervision_lab.synthesis.color_camera import Exposure, expose
from cucumbervision_lab.synthesis.depth_camera import D4xx, sense
from cucumbervision_lab.synthesis.raycast import Leaf, Plane
from cucumbervision_lab.synthesis.scene import FruitTruth, Scene, View, render, truth_of
from cucumbervision_lab.synthesis.shading import shade

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Simulated", "build_fruit", "build_scene", "simulate"]

FRAMES = 5
SCALE_SD = 0.01  # the data sheet allows 2 % at 2 m, taken as two standard deviations
SUN_NOISE, SUN_HOLES = 1.5, 0.10
WET_HOLES = 0.30
BACKDROP_M = 0.45
BACKGROUND_LEAVES = 14


@dataclass(frozen=True, eq=False)
class Simulated:
    """One simulated capture with its truth.

    Parameters
    ----------
    capture : Capture
        The burst, fused; black where `paint` was not asked. Its depth scale is exact.
    truth : FruitTruth
        Of its one fruit.
    view : View
        The exact picture.
    depth_scale : float
        What this camera would read over what is, had it not been calibrated: the sensor's scale
        error multiplies every depth, and so every length, by it.
    """

    capture: Capture
    truth: FruitTruth
    view: View
    depth_scale: float


def build_fruit(case: Case) -> Tube:
    """Make the case's fruit, lying along x with its middle at the origin.

    Examples
    --------
    >>> from cucumbervision_lab.benchmark.protocol import validation_cases
    >>> round(100 * build_fruit(validation_cases()[4]).thread_m, 2)
    38.0
    """
    bend = np.inf if case.bend_radius_m is None else case.bend_radius_m
    variety = variety_of(case.length_m)

    def grown(length_m: float) -> Tube:
        rng = np.random.default_rng(case.fruit_seed)
        return random_fruit(rng, length_m, variety, bend_radius_m=bend)

    tube = grown(case.length_m)
    if not case.by_thread:
        return tube
    length_m = case.length_m
    for _ in range(5):  # the thread grows almost evenly with the centreline
        length_m *= case.length_m / tube.thread_m
        tube = grown(length_m)
    return tube


def build_scene(case: Case) -> Scene:
    """Place the case's fruit before the camera, leaves behind it and, where asked, before it."""
    rng = np.random.default_rng(case.capture_seed)
    turn = rotation(case.roll_deg, case.tilt_deg, case.spin_deg)
    fruit = build_fruit(case)
    aside = rng.uniform(-0.04, 0.04, 2) * case.distance_m
    fruit = fruit.moved(turn, (*aside, case.distance_m))
    behind = _background(case, rng)
    before = _occluders(case, fruit, rng)
    plane = Plane.facing(case.distance_m + BACKDROP_M, *rng.uniform(-10, 10, 2))
    return Scene((fruit,), (*behind, *before), (), (plane,))


def simulate(case: Case, frames: int = FRAMES, paint: bool = False) -> Simulated:
    """Take one capture of a case.

    Parameters
    ----------
    case : Case
        What to take.
    frames : int
        Size of the burst.
    paint : bool
        Whether to draw colours, which only networks need.

    Returns
    -------
    Simulated
        The same for the same case, whatever else is drawn.
    """
    scene = build_scene(case)
    rng = np.random.default_rng(case.capture_seed + 1)
    sensor = _sensor(case)
    depths = sense(scene, sensor, rng, frames)
    view = render(scene, CAMERA)
    (truth,) = truth_of(scene, CAMERA, view)
    colors = [np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)] * frames
    if paint:
        colors = [
            _color_picture(scene, view, np.random.default_rng(case.capture_seed + 2))
        ] * frames
    color, depth_m, burst_frame = fuse_burst(colors, depths)
    capture = Capture(
        color,
        depth_m,
        CAMERA,
        name=case.name,
        burst_frame=burst_frame,
        burst_size=frames,
        masks=(truth.visible,),
        simulated=True,
    )
    scale = 1 + float(np.random.default_rng(case.capture_seed + 3).normal(0, SCALE_SD))
    return Simulated(capture, truth, view, scale)


def _color_picture(scene: Scene, view: View, rng: np.random.Generator) -> NDArray[np.uint8]:
    style = random_style(rng, scene, Assets(), "hanging")
    light = shade(scene, view, CAMERA, style, Assets(), rng)
    return expose(light, Exposure(), rng, view.depth_m)


def _sensor(case: Case) -> D4xx:
    sensor = D4xx.like(CAMERA)
    if case.condition == "sun":
        noise = sensor.disparity_rms_px * SUN_NOISE
        return replace(sensor, disparity_rms_px=noise, glare_holes=SUN_HOLES)
    if case.condition == "wet":
        return replace(sensor, glare_holes=WET_HOLES, foliage_holes=0.15)
    return sensor


def _background(case: Case, rng: np.random.Generator) -> list[Leaf]:
    leaves = []
    half_view = 0.5 * CAMERA.width / CAMERA.fx_px
    for _ in range(BACKGROUND_LEAVES):
        depth = case.distance_m + float(rng.uniform(0.12, BACKDROP_M - 0.05))
        at = np.array([*(rng.uniform(-1, 1, 2) * (half_view, 0.6 * half_view) * depth), depth])
        leaves.append(_leaf(at, rng, rng.uniform(0.05, 0.11), rng.uniform(0.04, 0.08), lean=35.0))
    return leaves


def _occluders(case: Case, fruit: Tube, rng: np.random.Generator) -> list[Leaf]:
    if case.hidden_share <= 0:
        return []
    axis = fruit.axis_m
    share = case.hidden_share
    middle = (
        0.5 * share if case.hidden_end else float(rng.uniform(0.15 + share / 2, 0.85 - share / 2))
    )
    if case.hidden_end and rng.random() < 0.5:
        middle = 1 - middle
    at = axis[round(middle * (len(axis) - 1))]
    before = float(rng.uniform(0.03, 0.08)) + fruit.radii_m.max()
    # Seen from the camera the leaf stands before the same pixels as the part it hides.
    shrink = max(at[2] - before, 0.1) / at[2]
    run = axis[-1] - axis[0]
    along = np.array([run[0], run[1], 0.0])
    seen = float(np.linalg.norm(along))
    along = along / seen if seen > 1e-6 else np.array([1.0, 0.0, 0.0])
    across = np.array([-along[1], along[0], 0.0])
    frame = np.stack([across, along, np.array([0.0, 0.0, -1.0])])
    wide = shrink * max(0.5 * share * seen, 0.004)
    high = shrink * float(rng.uniform(2.2, 4.0)) * fruit.radii_m.max()
    return [Leaf(at * shrink, frame, high, wide, (float(rng.uniform(-3, 3)), 0.0), 0.1)]


def _leaf(
    at: NDArray[np.float64], rng: np.random.Generator, length: float, width: float, lean: float
) -> Leaf:
    turn = rotation(float(rng.uniform(0, 360)), *rng.uniform(-lean, lean, 2))
    frame = turn @ np.diag([1.0, 1.0, -1.0])
    bend = (float(rng.uniform(-4, 4)), float(rng.uniform(-4, 4)))
    return Leaf(at, frame.T, float(length), float(width), bend, float(rng.uniform(0, 0.2)))
