"""The captures that come with the package: drawn, free to pass on, with exact truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.writer import write_native
from cucumbervision_lab.synthesis.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.synthesis.paint import bench_backdrop, leafy_backdrop, paint
from cucumbervision_lab.synthesis.scene import Scene, View, render
from cucumbervision_lab.synthesis.sensor import noisy_depth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["SCENES", "Pose", "Scene", "draw_scene", "place", "write_demo"]

CAMERA = Intrinsics(848, 480, 616.4, 616.2, 424.3, 239.6)  # a D435's colour camera at 848x480
FRAMES = 5
JPEG_QUALITY = 92


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
    """A named scene: the fruit in it, what lies behind at which depth, and the random seed."""

    name: str
    fruit: tuple[Pose, ...]
    backdrop: Literal["leaves", "bench"]
    backdrop_m: float
    seed: int


SCENES = (
    DemoScene(
        "simulated-row-a",
        (
            Pose(0.232, 0.021, np.inf, 0.25, -88.0, 3.0, 0.0, (-0.17, -0.01, 0.52)),
            Pose(0.265, 0.023, 0.42, 0.30, -97.0, -6.0, 30.0, (0.02, 0.0, 0.55)),
            Pose(0.148, 0.018, 0.30, 0.20, -80.0, 8.0, 160.0, (0.20, 0.03, 0.50)),
        ),
        "leaves",
        0.85,
        1,
    ),
    DemoScene(
        "simulated-row-b",
        (
            Pose(0.205, 0.019, 0.22, 0.30, -60.0, 12.0, 0.0, (-0.12, 0.02, 0.47)),
            Pose(0.310, 0.024, 0.60, 0.25, -93.0, 20.0, 200.0, (0.13, 0.0, 0.60)),
        ),
        "leaves",
        0.95,
        2,
    ),
    DemoScene(
        "simulated-bench",
        (
            Pose(0.162, 0.020, np.inf, 0.15, 4.0, 0.0, 0.0, (-0.16, -0.09, 0.50)),
            Pose(0.121, 0.017, 0.35, 0.15, 22.0, 0.0, 0.0, (0.16, -0.08, 0.50)),
            Pose(0.248, 0.022, 0.50, 0.25, -8.0, 0.0, 180.0, (0.02, 0.09, 0.50)),
        ),
        "bench",
        0.525,
        3,
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


def draw_scene(
    scene: DemoScene, camera: Intrinsics = CAMERA, frames: int = FRAMES
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.float32]], View, list[Tube]]:
    """Generate a burst of a scene.

    Parameters
    ----------
    scene : DemoScene
        What to draw.
    camera : Intrinsics
        The camera.
    frames : int
        Size of the burst.

    Returns
    -------
    colors : list of ndarray of uint8, shape (H, W, 3)
        RGB, each frame with its own noise and a little motion blur but one.
    depths_m : list of ndarray of float32, shape (H, W)
        As a D435 reads it, metres.
    rendering : View
        The exact picture.
    tubes : list of Tube
        The bodies.
    """
    rng = np.random.default_rng(scene.seed)
    tubes = [place(pose) for pose in scene.fruit]
    exact = render(Scene.of(*tubes, backdrop_m=scene.backdrop_m), camera)
    draw = leafy_backdrop if scene.backdrop == "leaves" else bench_backdrop
    backdrop = draw(camera.width, camera.height, rng)
    still = cv2.GaussianBlur(paint(exact, backdrop, rng), (0, 0), 0.6).astype(np.float64)
    sharpest = int(rng.integers(frames))
    colors = []
    for k in range(frames):
        seen = still if k == sharpest else cv2.blur(still, (3, 1 + k % 2))
        noisy = seen + rng.normal(0, 2.0, seen.shape)
        colors.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return colors, noisy_depth(exact.depth_m, camera.fx_px, frames, rng), exact, tubes


def write_demo(folder: Path, scenes: Sequence[DemoScene] = SCENES) -> list[Path]:
    """Generate the bundled captures as native capture folders, each with a `truth.json`.

    Parameters
    ----------
    folder : Path
        Where the capture folders go.
    scenes : sequence of Scene
        Which to draw.

    Returns
    -------
    list of Path
        One folder a scene.
    """
    return [_write_scene(folder / scene.name, scene, step) for step, scene in enumerate(scenes, 1)]


def _write_scene(folder: Path, scene: DemoScene, step: int) -> Path:
    colors, depths, exact, tubes = draw_scene(scene)
    masks = tuple(exact.mask(k) for k in range(len(tubes)))
    capture = Capture(
        colors[0],
        depths[0],
        CAMERA,
        name=scene.name,
        masks=masks,
        stop=Stop(row="demo", side="left", position_m=round(0.4 * step, 2), step=step),
        simulated=True,
        provenance={"drawn_by": "cucumbervision_lab.synthesis.demo", "seed": scene.seed},
    )
    manifest = write_native(capture, folder, burst=list(zip(colors, depths, strict=True)))
    _colors_as_jpeg(manifest)
    truth = [
        {
            "centreline_m": round(tube.centreline_m, 5),
            "thread_m": round(tube.thread_m, 5),
            "chord_m": round(tube.chord_m, 5),
            "visible_px": int(mask.sum()),
        }
        for tube, mask in zip(tubes, masks, strict=True)
    ]
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return folder


def _colors_as_jpeg(manifest: Path) -> None:
    # Noisy colour as PNG would make the package three times as large.
    content = json.loads(manifest.read_text(encoding="utf-8"))
    for frame in content["frames"]:
        png = manifest.parent / frame["color"]
        jpeg = png.with_suffix(".jpg")
        picture = np.asarray(cv2.imread(str(png)))
        cv2.imwrite(str(jpeg), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        png.unlink()
        frame["color"] = jpeg.name
    manifest.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
