"""BOP scenes: `rgb/`, `depth/`, `scene_camera.json` and, optionally, `mask_visib/`.

The format is that of the BOP benchmark (Hodaň et al. 2018); `scene_gt.json` is not needed.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, Field

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import COLOR_SUFFIXES, read_color, read_depth, read_masks
from cucumbervision.capture.readers.common import frame_capture
from cucumbervision.capture.source import fail, safe_name
from cucumbervision.errors import CaptureError, IntrinsicsError, as_errors_of
from cucumbervision.files import parse_model, read_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from cucumbervision.capture.camera_file import CameraFile
    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import Folder, Listed, Opener, ReadOptions

SCENE_CAMERAS = "scene_camera.json"
_PARTS = ("rgb", "depth", "mask_visib")


class _FrameCamera(BaseModel):
    cam_K: list[float] = Field(min_length=9, max_length=9)  # noqa: N815 - BOP's own key
    depth_scale: float = Field(default=1.0, gt=0)


def find_scenes(folder: Folder) -> Opener | None:
    """Find BOP scenes; given intrinsics replace `cam_K`, a given depth unit `depth_scale`."""
    found = folder.take(SCENE_CAMERAS, *_PARTS)
    return partial(_open_scenes, folder.path, found) if found else None


def _open_scenes(
    path: Path,
    scenes: Mapping[str, Mapping[str, list[str]]],
    options: ReadOptions,
    given: CameraFile | None,
) -> Iterator[Listed]:
    for at, names in scenes.items():
        files = {kind: _by_image(path / at / kind, names[kind]) for kind in _PARTS}
        if not any(files.values()):
            raise CaptureError(
                "has no images in rgb/", source=path / at, remedy="check the scene's folder"
            )
        prefix = safe_name("_".join((path.resolve().name, *Path(at).parts)))
        yield from _scene(path / at, prefix, files, given, options)


def _scene(
    scene: Path,
    prefix: str,
    files: Mapping[str, Mapping[int, list[Path]]],
    given: CameraFile | None,
    options: ReadOptions,
) -> Iterator[Listed]:
    cameras, fault = dict[str, Any](), None
    try:
        cameras = read_json(scene / SCENE_CAMERAS)
        if not isinstance(cameras, dict):
            raise CaptureError(
                "is not an object of image ids",
                source=scene / SCENE_CAMERAS,
                remedy="correct the file",
            )
    except CaptureError as error:
        # Other scenes of the data set can still be loaded.
        fault = error
    # A mask or depth picture without a colour picture is reported as a broken frame.
    for image in sorted(set().union(*files.values())):
        own = {kind: found.get(image, []) for kind, found in files.items()}
        said = None if fault else cameras.get(str(image))
        load = partial(_load, scene, image, own, said, given, options)
        yield (
            f"{prefix}_{image:06d}",
            image,
            partial(fail, fault) if fault else load,
            scene / f"rgb/{image:06d}",
            partial(_read_from, own, said, given),
        )


def _read_from(
    files: dict[str, list[Path]], camera: Any, given: CameraFile | None
) -> list[Path | bytes]:
    """Return the inputs of a frame, including only its own camera entry."""
    beside = [] if given is None else [given.path]
    pictures = files["rgb"][:1] + files["depth"][:1] + files["mask_visib"]
    return [json.dumps(camera).encode(), *pictures, *beside]


def _by_image(folder: Path, names: Iterable[str]) -> dict[int, list[Path]]:
    found: dict[int, list[Path]] = {}
    for file in (folder / name for name in names):
        number = file.stem.split("_")[0]
        if file.suffix.lower() in COLOR_SUFFIXES and number.isdecimal() and len(number) < 19:
            found.setdefault(int(number), []).append(file)
    return found


def _load(
    scene: Path,
    image: int,
    files: dict[str, list[Path]],
    said: Any,
    given: CameraFile | None,
    options: ReadOptions,
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
    color = read_color(files["rgb"][0])
    height, width = color.shape[:2]
    with as_errors_of(camera_path):
        own = Intrinsics.from_matrix(camera.cam_K, width, height)
    return frame_capture(
        color,
        partial(read_depth, files["depth"][0]),
        own,
        given and replace(given, depth_to_color=None),  # aligned by definition
        # BOP: depth_scale times the stored number is millimetres.
        options.depth_unit_m or camera.depth_scale * 0.001,
        options,
        source=files["rgb"][0],
        depth_source=files["depth"][0],
        name=name,
        frame=image,
        masks=read_masks(files["mask_visib"], color.shape),
        provenance={"reader": "bop", "scene": scene.name},
    )
