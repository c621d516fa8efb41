"""BOP scenes: `rgb/`, `depth/`, `scene_camera.json` and, optionally, `mask_visib/`.

The format is that of the BOP benchmark (Hodaň et al. 2018); `scene_gt.json` is not needed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from cucumbervision.capture import source as sources
from cucumbervision.capture.camera_file import CameraFile
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import COLOR_SUFFIXES, read_color, read_depth, read_masks
from cucumbervision.capture.readers.common import frame_capture
from cucumbervision.errors import CaptureError, IntrinsicsError, as_errors_of
from cucumbervision.files import parse_model, read_json

SCENE_CAMERAS = "scene_camera.json"
_PARTS = ("rgb", "depth", "mask_visib")


class _FrameCamera(BaseModel):
    cam_K: list[float] = Field(min_length=9, max_length=9)  # noqa: N815 - BOP's own key
    depth_scale: float = Field(default=1.0, gt=0)


def find_scenes(folder: sources.Folder) -> sources.CaptureLister | None:
    """Find BOP scenes; given intrinsics replace `cam_K`, a given depth unit `depth_scale`."""
    scenes = folder.take(SCENE_CAMERAS, *_PARTS)
    return partial(_open_scenes, folder.path, scenes) if scenes else None


def _open_scenes(
    path: Path,
    scenes: Mapping[str, Mapping[str, list[str]]],
    options: sources.ReadOptions,
    camera_file: CameraFile | None,
) -> Iterator[sources.CaptureEntry]:
    for scene_path, names in scenes.items():
        scene = path / scene_path
        files = {kind: _by_image(scene / kind, names[kind]) for kind in _PARTS}
        if not any(files.values()):
            remedy = "check the scene's folder"
            raise CaptureError("has no images in rgb/", source=scene, remedy=remedy)
        prefix = sources.safe_name("_".join((path.resolve().name, *Path(scene_path).parts)))
        cameras, fault = dict[str, Any](), None
        try:
            file = scene / SCENE_CAMERAS
            cameras = parse_model(dict[str, Any], read_json(file), source=file)
        except CaptureError as error:
            fault = error  # other scenes of the data set can still be loaded
        # A mask or depth image without a colour image is reported as a broken frame.
        for number in sorted(set().union(*files.values())):
            pictures = {kind: numbered.get(number, []) for kind, numbered in files.items()}
            entry = None if fault else cameras.get(str(number))
            image = _Image(scene, number, pictures, entry, camera_file, options)
            load = partial(sources.fail, fault) if fault else image.load
            yield f"{prefix}_{number:06d}", number, load, scene / f"rgb/{number:06d}", image.parts


def _by_image(folder: Path, names: Iterable[str]) -> dict[int, list[Path]]:
    by_number: dict[int, list[Path]] = {}
    for file in (folder / name for name in names):
        number = file.stem.split("_")[0]
        if file.suffix.lower() in COLOR_SUFFIXES and number.isdecimal() and len(number) < 19:
            by_number.setdefault(int(number), []).append(file)
    return by_number


@dataclass(frozen=True)
class _Image:
    """Files of one image of a scene, and its entry of the scene's cameras."""

    scene: Path
    number: int
    files: Mapping[str, list[Path]]
    camera: Any
    camera_file: CameraFile | None
    options: sources.ReadOptions

    def parts(self) -> list[Path | bytes]:
        """Return the inputs of the image, including only its own camera entry."""
        camera_files = [] if self.camera_file is None else [self.camera_file.path]
        pictures = (self.files[kind][: None if kind == "mask_visib" else 1] for kind in _PARTS)
        return [json.dumps(self.camera).encode(), *chain(*pictures), *camera_files]

    def load(self, name: str) -> Capture:
        """Read the image."""
        files, camera_path = self.files, self.scene / SCENE_CAMERAS
        for kind in ("rgb", "depth"):
            if not files[kind]:
                fault = f"image {self.number} is missing, which other files of the scene name"
                path = self.scene / kind / f"{self.number:06d}.png"
                raise CaptureError(fault, source=path, remedy="copy the scene again")
        if self.camera is None:
            fault = f"has no entry for image {self.number}"
            raise IntrinsicsError(fault, source=camera_path, remedy="add its cam_K")
        camera = parse_model(_FrameCamera, self.camera, source=camera_path, error=IntrinsicsError)
        color = read_color(files["rgb"][0])
        height, width = color.shape[:2]
        with as_errors_of(camera_path):
            scene_intrinsics = Intrinsics.from_matrix(camera.cam_K, width, height)
        # BOP: depth_scale times the stored number is millimetres.
        unit_m = self.options.depth_unit_m or camera.depth_scale * 0.001
        return frame_capture(
            color,
            partial(read_depth, files["depth"][0]),
            scene_intrinsics,
            self.camera_file
            and self.camera_file.model_copy(update={"depth_to_color": None}),  # aligned
            replace(self.options, depth_unit_m=unit_m),
            source=files["rgb"][0],
            depth_source=files["depth"][0],
            name=name,
            frame=self.number,
            masks=read_masks(files["mask_visib"], color.shape),
            provenance={"reader": "bop", "scene": self.scene.name},
        )
