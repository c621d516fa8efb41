"""The captures that come with the package: simulated, free to pass on, with exact truth.

    python website/demo_captures.py FOLDER    # writes them anew, with shaded colours

The bundled colours were path-traced once; depth, masks and truth are the same bodies, ray cast.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_color, read_depth, write_jpeg
from cucumbervision.capture.readers.native import write_native
from cucumbervision_lab.scenes.appearance import FAR, Assets, random_style
from cucumbervision_lab.scenes.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.scenes.color_camera import Exposure, expose
from cucumbervision_lab.scenes.colors import jitter
from cucumbervision_lab.scenes.compose import Setting
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.lighting import Light
from cucumbervision_lab.scenes.placing import foliage
from cucumbervision_lab.scenes.raycast import Plane, Stem, scaled_camera
from cucumbervision_lab.scenes.scene import FruitTruth, Scene, render, truth_of
from cucumbervision_lab.scenes.shading import shade
from cucumbervision_lab.scenes.skin import random_skin

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

CAMERA = Intrinsics(848, 480, 616.4, 616.2, 424.3, 239.6)  # a D435's colour camera at 848x480
_BENCH_M = 0.522
_STUB_M = 0.008
_WOOD = (172.0, 138.0, 100.0)
_LAYERS = (
    (0.12, 1.3),
    (0.35, 1.5),
    (0.6, 1.5),
)  # metres behind the fruit, leaf area for each area of view
_FRAMES = 5
_JPEG_QUALITY = 90
_STILL = Exposure(
    highlights=1.2, stops=-0.25, contrast=1.1, saturation=1.1, shot=0.0003, read=0.001, quality=0
)


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
    """A named scene: its fruit, setting, skin's kind and sRGB, light, seeds of shape and colour."""

    name: str
    fruit: tuple[Pose, ...]
    setting: Setting
    look: str
    base: tuple[float, float, float]
    light: Light
    seed: int
    color_seed: int = 2


SCENES = (
    DemoScene(
        "simulated-row-a",
        (
            Pose(0.232, 0.021, np.inf, 0.25, -88.0, 3.0, 0.0, (-0.17, -0.01, 0.52)),
            Pose(0.265, 0.023, 0.42, 0.30, -97.0, -6.0, 30.0, (0.02, 0.0, 0.55)),
            Pose(0.148, 0.018, 0.30, 0.20, -80.0, 8.0, 160.0, (0.20, 0.03, 0.50)),
        ),
        Setting.HANGING,
        "long",
        (38.0, 82.0, 36.0),
        Light((-0.45, -0.75, -0.48), (1.08, 1.0, 0.92), sun_strength=1.6, shade=0.35),
        1,
    ),
    DemoScene(
        "simulated-row-b",
        (
            Pose(0.205, 0.019, 0.22, 0.30, -60.0, 12.0, 0.0, (-0.12, 0.02, 0.47)),
            Pose(0.310, 0.024, 0.60, 0.25, -93.0, 20.0, 200.0, (0.13, 0.0, 0.60)),
        ),
        Setting.HANGING,
        "long",
        (34.0, 76.0, 34.0),
        Light((-0.45, -0.75, -0.48), (1.08, 1.0, 0.92), sun_strength=3.0, shade=0.35),
        2,
        3,
    ),
    DemoScene(
        "simulated-bench",
        (
            Pose(0.162, 0.020, np.inf, 0.15, 4.0, 0.0, 0.0, (-0.16, -0.09, 0.502)),
            Pose(0.121, 0.017, 0.35, 0.15, 22.0, 0.0, 0.0, (0.16, -0.08, 0.505)),
            Pose(0.248, 0.022, 0.50, 0.25, -20.0, 0.0, 180.0, (0.02, 0.09, 0.500)),
        ),
        Setting.BENCH,
        "slicing",
        (40.0, 86.0, 36.0),
        Light((-0.5, -0.5, -0.7), (1.04, 1.0, 0.96), sun_strength=1.5, up=(0.0, 0.0, -1.0)),
        4,
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


def build_scene(demo: DemoScene) -> tuple[Scene, tuple[str, ...], tuple[str, ...]]:
    """Build a scene: the fruit on their vines before leaves, or lying on a bench.

    Parameters
    ----------
    demo : DemoScene
        What to build.

    Returns
    -------
    scene : Scene
        In the camera's coordinates.
    leaf_roles, stem_roles : tuple of str
        What each leaf and stem stands for, as `random_style` takes them.
    """
    rng = np.random.default_rng(demo.seed)
    fruit = tuple(place(pose) for pose in demo.fruit)
    if demo.setting is Setting.BENCH:
        stubs = tuple(_stub(tube) for tube in fruit)
        return Scene(fruit, (), stubs, (Plane.facing(_BENCH_M),)), (), ("stalk",) * len(stubs)
    deepest_m = max(float((tube.centres_m[:, 2] + tube.radii_m).max()) for tube in fruit)
    layers = [
        foliage(rng, CAMERA, deepest_m + behind_m, 0.2, density) for behind_m, density in _LAYERS
    ]
    leaves = tuple(replace(leaf, teeth=0.04) for layer in reversed(layers) for leaf in layer)
    vines = [stem for tube in fruit for stem in _vine(rng, tube)]
    wall = Plane.facing(deepest_m + 1.2)
    scene = Scene(fruit, leaves, tuple(vines), (wall,))
    return scene, ("leaf",) * len(leaves), ("stem", "stalk", "string") * len(fruit)


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


def _draw_scene(
    demo: DemoScene, frames: int = _FRAMES
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.float32]], tuple[FruitTruth, ...]]:
    """Render a burst of a scene.

    Parameters
    ----------
    demo : DemoScene
        What to render.
    frames : int
        Size of the burst.

    Returns
    -------
    colors : list of ndarray of uint8, shape (H, W, 3)
        RGB, each frame with its own noise and all but one with a little motion blur.
    depths_m : list of ndarray of float32, shape (H, W)
        As a D435 reads it, metres.
    truth : tuple of FruitTruth
        Of each fruit.
    """
    scene, leaf_roles, stem_roles = build_scene(demo)
    view = render(scene, CAMERA)
    light = _light(demo, scene, leaf_roles, stem_roles)
    rng = np.random.default_rng([demo.seed, 1])
    sharpest = int(rng.integers(frames))
    colors = [
        expose(light, _STILL if k == sharpest else replace(_STILL, motion_px=2.0), rng)
        for k in range(frames)
    ]
    depths_m = sense(scene, D4xx.like(CAMERA), rng, frames)
    return colors, depths_m, truth_of(scene, CAMERA, view)


def _light(
    demo: DemoScene, scene: Scene, leaf_roles: tuple[str, ...], stem_roles: tuple[str, ...]
) -> NDArray[np.float32]:
    rng = np.random.default_rng([demo.seed, demo.color_seed])
    style = random_style(
        rng, scene, Assets(), demo.setting.value, leaf_roles=leaf_roles, stem_roles=stem_roles
    )
    kin = replace(random_skin(rng, demo.look, Assets()), tip_reach=0.14)
    skins = tuple(replace(kin, base=jitter(rng, demo.base, 0.06), bloom=0.08) for _ in scene.fruit)
    bench = demo.setting is Setting.BENCH
    style = replace(
        style,
        light=demo.light,
        skins=skins,
        far="leaves",
        materials=("wood" if bench else FAR,),
        material_colors=(_WOOD,),
        gloom_per_m=0.0 if bench else 2.2,
    )
    # Shaded at twice the size and averaged, which smooths every outline.
    fine = scaled_camera(CAMERA, 2.0)
    light = shade(scene, render(scene, fine), fine, style, Assets(), rng)
    return np.asarray(cv2.resize(light, CAMERA.size, interpolation=cv2.INTER_AREA))


def write_demo(folder: Path, scenes: Sequence[DemoScene] = SCENES) -> list[Path]:
    """Write the bundled captures as native capture folders, each with a `truth.json`.

    Parameters
    ----------
    folder : Path
        Where the capture folders go.
    scenes : sequence of DemoScene
        Which to render.

    Returns
    -------
    list of Path
        One folder a scene.
    """
    return [_write_scene(folder / scene.name, scene, step) for step, scene in enumerate(scenes, 1)]


def _write_scene(folder: Path, scene: DemoScene, step: int) -> Path:
    colors, depths, truth = _draw_scene(scene)
    capture = Capture(
        colors[0],
        depths[0],
        CAMERA,
        name=scene.name,
        masks=tuple(fruit.visible for fruit in truth),
        stop=Stop(row="demo", side="left", position_m=round(0.4 * step, 2), step=step),
        simulated=True,
        provenance={"drawn_by": "website/demo_captures.py", "seed": scene.seed},
    )
    manifest = write_native(capture, folder, burst=list(zip(colors, depths, strict=True)))
    _compress(manifest)
    lengths = [
        {
            "centreline_m": round(fruit.centreline_m, 5),
            "thread_m": round(fruit.thread_m, 5),
            "chord_m": round(fruit.chord_m, 5),
            "visible_px": int(fruit.visible.sum()),
        }
        for fruit in truth
    ]
    (folder / "truth.json").write_text(json.dumps(lengths, indent=1) + "\n", encoding="utf-8")
    return folder


def _compress(manifest: Path) -> None:
    # Noisy colour as PNG would make the package three times as large.
    content = json.loads(manifest.read_text(encoding="utf-8"))
    for frame in content["frames"]:
        png, depth = manifest.parent / frame["color"], manifest.parent / frame["depth"]
        write_jpeg(png.with_suffix(".jpg"), read_color(png), _JPEG_QUALITY)
        png.unlink()
        frame["color"] = png.with_suffix(".jpg").name
        cv2.imwrite(str(depth), read_depth(depth), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    manifest.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_demo(Path(sys.argv[1]))
