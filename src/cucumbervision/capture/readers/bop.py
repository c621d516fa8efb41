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
    from cucumbervision.capture.source import CaptureEntry, CaptureLister, Folder, ReadOptions

SCENE_CAMERAS = "scene_camera.json"
_PARTS = ("rgb", "depth", "mask_visib")


class _FrameCamera(BaseModel):
    cam_K: list[float] = Field(min_length=9, max_length=9)  # noqa: N815 - BOP's own key
    depth_scale: float = Field(default=1.0, gt=0)


def find_scenes(folder: Folder) -> CaptureLister | None:
    """Find BOP scenes; given intrinsics replace `cam_K`, a given depth unit `depth_scale`."""
    scenes = folder.take(SCENE_CAMERAS, *_PARTS)
    return partial(_open_scenes, folder.path, scenes) if scenes else None


def _open_scenes(
    path: Path,
    scenes: Mapping[str, Mapping[str, list[str]]],
    options: ReadOptions,
    camera_file: CameraFile | None,
) -> Iterator[CaptureEntry]:
    for scene_path, names in scenes.items():
        files = {kind: _by_image(path / scene_path / kind, names[kind]) for kind in _PARTS}
        if not any(files.values()):
            raise CaptureError(
                "has no images in rgb/", source=path / scene_path, remedy="check the scene's folder"
            )
        prefix = safe_name("_".join((path.resolve().name, *Path(scene_path).parts)))
        yield from _scene(path / scene_path, prefix, files, camera_file, options)


def _scene(
    scene: Path,
    prefix: str,
    files: Mapping[str, Mapping[int, list[Path]]],
    camera_file: CameraFile | None,
    options: ReadOptions,
) -> Iterator[CaptureEntry]:
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
        pictures = {kind: numbered.get(image, []) for kind, numbered in files.items()}
        frame_camera = None if fault else cameras.get(str(image))
        load = partial(_load, scene, image, pictures, frame_camera, camera_file, options)
        yield (
            f"{prefix}_{image:06d}",
            image,
            partial(fail, fault) if fault else load,
            scene / f"rgb/{image:06d}",
            partial(_read_from, pictures, frame_camera, camera_file),
        )


def _read_from(
    files: dict[str, list[Path]], camera: Any, camera_file: CameraFile | None
) -> list[Path | bytes]:
    """Return the inputs of a frame, including only its own camera entry."""
    camera_files = [] if camera_file is None else [camera_file.path]
    pictures = files["rgb"][:1] + files["depth"][:1] + files["mask_visib"]
    return [json.dumps(camera).encode(), *pictures, *camera_files]


def _by_image(folder: Path, names: Iterable[str]) -> dict[int, list[Path]]:
    by_number: dict[int, list[Path]] = {}
    for file in (folder / name for name in names):
        number = file.stem.split("_")[0]
        if file.suffix.lower() in COLOR_SUFFIXES and number.isdecimal() and len(number) < 19:
            by_number.setdefault(int(number), []).append(file)
    return by_number


def _load(
    scene: Path,
    image: int,
    files: dict[str, list[Path]],
    frame_camera: Any,
    camera_file: CameraFile | None,
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
    if frame_camera is None:
        raise IntrinsicsError(
            f"has no entry for image {image}", source=camera_path, remedy="add its cam_K"
        )
    camera = parse_model(_FrameCamera, frame_camera, source=camera_path, error=IntrinsicsError)
    color = read_color(files["rgb"][0])
    height, width = color.shape[:2]
    with as_errors_of(camera_path):
        scene_intrinsics = Intrinsics.from_matrix(camera.cam_K, width, height)
    return frame_capture(
        color,
        partial(read_depth, files["depth"][0]),
        scene_intrinsics,
        camera_file and replace(camera_file, depth_to_color=None),  # aligned by definition
        # BOP: depth_scale times the stored number is millimetres.
        replace(options, depth_unit_m=options.depth_unit_m or camera.depth_scale * 0.001),
        source=files["rgb"][0],
        depth_source=files["depth"][0],
        name=name,
        frame=image,
        masks=read_masks(files["mask_visib"], color.shape),
        provenance={"reader": "bop", "scene": scene.name},
    )
