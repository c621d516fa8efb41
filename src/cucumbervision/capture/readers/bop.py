"""BOP scenes: `rgb/`, `depth/`, `scene_camera.json` and, optionally, `mask_visib/`.

The format is that of the BOP benchmark (Hodaň et al. 2018); `scene_gt.json` is not needed.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, Field

from cucumbervision.capture.depth import depth_to_metres, require_readings
from cucumbervision.capture.files import (
    COLOR_SUFFIXES,
    parse_model,
    read_color,
    read_depth,
    read_json,
    read_mask,
)
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers.common import (
    choose_intrinsics,
    given_calibration,
    require_same_size,
)
from cucumbervision.capture.source import CaptureSource, ReadOptions, fail, safe_name
from cucumbervision.errors import CaptureError, IntrinsicsError, as_errors_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from cucumbervision.capture.camera_file import CameraFile
    from cucumbervision.capture.source import Listed

SCENE_CAMERAS = "scene_camera.json"


class _FrameCamera(BaseModel):
    cam_K: list[float] = Field(min_length=9, max_length=9)  # noqa: N815 - BOP's own key
    depth_scale: float = Field(default=1.0, gt=0)


def open_bop(path: Path, scenes: Sequence[Path], options: ReadOptions) -> CaptureSource:
    """Open BOP scenes.

    Parameters
    ----------
    path : Path
        What the user named.
    scenes : sequence of Path
        The scenes in it, in order.
    options : ReadOptions
        The user's intrinsics replace `cam_K` if the guard lets them pass; a depth unit
        replaces `depth_scale`.

    Raises
    ------
    CaptureError
        If no scene has a single image, or the user's intrinsics file cannot be read.
    """
    given = given_calibration(options)
    parts = (part for scene in scenes for part in _parts(path, scene, given, options.depth_unit_m))
    source = CaptureSource.listed(path, "bop", parts)
    if not source.total:
        raise CaptureError("has no images in rgb/", source=path, remedy="check the scene's folder")
    return source


def _parts(
    path: Path, scene: Path, given: CameraFile | None, unit_m: float | None
) -> Iterator[Listed]:
    prefix = safe_name("_".join((path.resolve().name, *scene.relative_to(path).parts)))
    files = {kind: _by_image(scene / kind) for kind in ("rgb", "depth", "mask_visib")}
    cameras, fault = dict[str, Any](), None
    try:
        cameras = read_json(scene / SCENE_CAMERAS)
        if not isinstance(cameras, dict):
            raise CaptureError(
                "is no object of image ids", source=scene / SCENE_CAMERAS, remedy="correct the file"
            )
    except CaptureError as error:
        # The other scenes of a data set still load.
        fault = error
    # A mask or depth picture without its colour picture is a broken frame, not none.
    for image in sorted(set().union(*files.values())):
        own = {kind: found.get(image, []) for kind, found in files.items()}
        said = None if fault else cameras.get(str(image))
        load = partial(_load, scene, image, own, said, given, unit_m)
        at, name = scene / f"rgb/{image:06d}", f"{prefix}_{image:06d}"
        yield (
            name,
            image,
            partial(fail, fault) if fault else load,
            at,
            partial(_read_from, own, said, given),
        )


def _read_from(
    files: dict[str, list[Path]], camera: Any, given: CameraFile | None
) -> list[Path | bytes]:
    """Return what a frame is read from: of the scene's cameras its own alone."""
    beside = [] if given is None else [given.path]
    pictures = files["rgb"][:1] + files["depth"][:1] + files["mask_visib"]
    return [json.dumps(camera).encode(), *pictures, *beside]


def _by_image(folder: Path) -> dict[int, list[Path]]:
    found: dict[int, list[Path]] = {}
    for file in sorted(folder.glob("*")):
        number = file.stem.split("_")[0]
        if file.suffix.lower() in COLOR_SUFFIXES and number.isdecimal():
            found.setdefault(int(number), []).append(file)
    return found


def _load(
    scene: Path,
    image: int,
    files: dict[str, list[Path]],
    said: Any,
    given: CameraFile | None,
    unit_m: float | None,
    name: str,
) -> Capture:
    for kind in ("rgb", "depth"):
        if not files[kind]:
            raise CaptureError(
                f"image {image} is missing, which other files of the scene name",
                source=scene / kind / f"{image:06d}.png",
                remedy="copy the scene again",
            )
    camera_path = scene / SCENE_CAMERAS
    if said is None:
        raise IntrinsicsError(
            f"has no entry for image {image}", source=camera_path, remedy="add its cam_K"
        )
    camera = parse_model(_FrameCamera, said, source=camera_path, error=IntrinsicsError)
    color_path, depth_path = files["rgb"][0], files["depth"][0]
    color, raw = read_color(color_path), read_depth(depth_path)
    height, width = color.shape[:2]
    require_same_size(color, raw, source=depth_path)
    with as_errors_of(camera_path):
        own = Intrinsics.from_matrix(camera.cam_K, width, height)
    intrinsics = choose_intrinsics(own, given, width, height, source=scene)
    # BOP: depth_scale times the stored number is millimetres.
    depth_m = depth_to_metres(raw, unit_m or camera.depth_scale * 0.001, source=depth_path)
    require_readings(depth_m, source=depth_path)
    return Capture(
        color,
        depth_m,
        intrinsics,
        name,
        frame=image,
        masks=tuple(read_mask(m, color.shape) for m in files["mask_visib"]),
        source=str(color_path),
        provenance={"reader": "bop", "scene": scene.name},
    )
