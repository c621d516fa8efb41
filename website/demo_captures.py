"""The bodies of the captures that come with the package: simulated, with exact truth.

The bundled colours were path-traced once, depth and masks ray cast, of these bodies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.scenes.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.scenes.placing import foliage
from cucumbervision_lab.scenes.scene import Plane, Scene, Stem

CAMERA = Intrinsics(848, 480, 616.4, 616.2, 424.3, 239.6)  # a D435's colour camera at 848x480
_BENCH_M = 0.522
_STUB_M = 0.008
# Metres behind the fruit, leaf area for each area of view.
_LAYERS = ((0.12, 1.3), (0.35, 1.5), (0.6, 1.5))


@dataclass(frozen=True)
class Pose:
    """One fruit: its shape, and where it hangs.

    Parameters
    ----------
    length_m, radius_m, bend_radius_m, neck : float
        As `arc_tube` takes them.
    roll_deg, tilt_deg, spin_deg : float
        As `rotation` takes them; a fruit hanging from its stem has a roll of -90.
    at_m : tuple of float
        The middle of its axis, camera coordinates, metres.
    """

    length_m: float
    radius_m: float
    bend_radius_m: float
    neck: float
    roll_deg: float
    tilt_deg: float
    spin_deg: float
    at_m: tuple[float, float, float]


@dataclass(frozen=True)
class DemoScene:
    """A named scene: its fruit, whether they lie on a bench, and the seed of plants."""

    name: str
    fruit: tuple[Pose, ...]
    seed: int
    bench: bool = False


SCENES = (
    DemoScene(
        "simulated-row-a",
        (
            Pose(0.232, 0.021, np.inf, 0.25, -88.0, 3.0, 0.0, (-0.17, -0.01, 0.52)),
            Pose(0.265, 0.023, 0.42, 0.30, -97.0, -6.0, 30.0, (0.02, 0.0, 0.55)),
            Pose(0.148, 0.018, 0.30, 0.20, -80.0, 8.0, 160.0, (0.20, 0.03, 0.50)),
        ),
        1,
    ),
    DemoScene(
        "simulated-row-b",
        (
            Pose(0.205, 0.019, 0.22, 0.30, -60.0, 12.0, 0.0, (-0.12, 0.02, 0.47)),
            Pose(0.310, 0.024, 0.60, 0.25, -93.0, 20.0, 200.0, (0.13, 0.0, 0.60)),
        ),
        2,
    ),
    DemoScene(
        "simulated-bench",
        (
            Pose(0.162, 0.020, np.inf, 0.15, 4.0, 0.0, 0.0, (-0.16, -0.09, 0.502)),
            Pose(0.121, 0.017, 0.35, 0.15, 22.0, 0.0, 0.0, (0.16, -0.08, 0.505)),
            Pose(0.248, 0.022, 0.50, 0.25, -20.0, 0.0, 180.0, (0.02, 0.09, 0.500)),
        ),
        4,
        bench=True,
    ),
)


def place(pose: Pose) -> Tube:
    """Return the body of a pose in camera coordinates.

    Examples
    --------
    >>> round(place(SCENES[0].fruit[0]).centreline_m, 4)
    0.232
    """
    tube = arc_tube(pose.length_m, pose.radius_m, pose.bend_radius_m, neck=pose.neck)
    turn = rotation(pose.roll_deg, pose.tilt_deg, pose.spin_deg)
    return tube.moved(turn, pose.at_m)


def build_scene(demo: DemoScene) -> Scene:
    """Build a scene in the camera's coordinates: fruit on their vines, or lying on a bench."""
    rng = np.random.default_rng(demo.seed)
    fruit = tuple(place(pose) for pose in demo.fruit)
    if demo.bench:
        return Scene(fruit, (), tuple(map(_stub, fruit)), (Plane.facing(_BENCH_M),))
    deepest_m = max(float((tube.centres_m[:, 2] + tube.radii_m).max()) for tube in fruit)
    layers = [
        foliage(rng, CAMERA, deepest_m + behind_m, 0.2, density) for behind_m, density in _LAYERS
    ]
    leaves = tuple(leaf for layer in reversed(layers) for leaf in layer)
    vines = [stem for tube in fruit for stem in _vine(rng, tube)]
    wall = Plane.facing(deepest_m + 1.2)
    return Scene(fruit, leaves, tuple(vines), (wall,))


def _stub(tube: Tube) -> Stem:
    """Return the short end of the stalk that a picked fruit keeps."""
    pole, inner = tube.poles_m[1], tube.centres_m[-1]
    out = (pole - inner) / np.linalg.norm(pole - inner)
    return Stem(np.stack([pole - 0.003 * out, pole + _STUB_M * out]), 0.0035)


def _vine(rng: np.random.Generator, tube: Tube) -> tuple[Stem, Stem, Stem]:
    """Return the main stem that a fruit hangs from, the fruit's stalk, and the stem's string."""
    pole, inner = tube.poles_m[1], tube.centres_m[-1]
    out = (pole - inner) / np.linalg.norm(pole - inner)
    aside = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.025, 0.04))
    node = pole + np.array([aside, -0.035, 0.03])
    y = np.linspace(-0.5, 0.5, 11)
    sway = 0.006 * np.cumsum(rng.normal(size=11))
    line = np.stack([node[0] + sway - sway[5], node[1] + y, node[2] + 0 * y], axis=1)
    # A quadratic Bézier curve that leaves the fruit along its axis and bends away from the camera.
    s = np.linspace(0, 1, 8)[:, None]
    bend = pole + 0.02 * out + np.array([0.0, 0.0, 0.02])
    stalk = (1 - s) ** 2 * (pole - 0.003 * out) + 2 * s * (1 - s) * bend + s**2 * node
    twine = line + np.array([0.008, 0.0, 0.004])
    return Stem(line, 0.0045), Stem(stalk, 0.0022), Stem(twine, 0.001)
