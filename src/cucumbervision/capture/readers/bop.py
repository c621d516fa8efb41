"""BOP scenes: `rgb/`, `depth/`, `scene_camera.json` and, optionally, `mask_visib/`.

The format is that of the BOP benchmark (Hodaň et al. 2018); `scene_gt.json` is not needed.
"""

from __future__ import annotations

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
from cucumbervision.capture.source import (
    CaptureRef,
    CaptureSource,
    ReadOptions,
    safe_name,
    unique_names,
)
from cucumbervision.errors import CaptureError, IntrinsicsError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.capture.camera_file import CameraFile

__all__ = ["find_scenes", "open_bop"]

_CAMERA_FILE = "scene_camera.json"


class _FrameCamera(BaseModel):
    cam_K: list[float] = Field(min_length=9, max_length=9)  # noqa: N815 - BOP's own key
    depth_scale: float = Field(default=1.0, gt=0)


def find_scenes(path: Path) -> list[Path]:
    """Return the BOP scenes in a folder: itself, or every one below it, in order."""
    if (path / _CAMERA_FILE).is_file():
        return [path]
    return sorted(p.parent for p in path.rglob(_CAMERA_FILE))


def open_bop(path: Path, scenes: Sequence[Path], options: ReadOptions) -> CaptureSource:
    """Open BOP scenes.

    Parameters
    ----------
    path : Path
        What the user named.
    scenes : sequence of Path
        From `find_scenes`.
    options : ReadOptions
        The user's intrinsics replace `cam_K` if the guard lets them pass; a depth unit
        replaces `depth_scale`.

    Raises
    ------
    CaptureError
        If no scene has a single image, or the user's intrinsics file cannot be read.
    """
    given = given_calibration(options)
    refs: list[CaptureRef] = []
    for scene in scenes:
        parts = (path.resolve().name, *scene.relative_to(path).parts)
        refs.extend(_scene_refs(scene, safe_name("_".join(parts)), given, options))
    if not refs:
        raise CaptureError("has no images in rgb/", source=path, remedy="check the scene's folder")
    names = unique_names(r.name for r in refs)
    refs = [CaptureRef(n, r.frame, r.load) for n, r in zip(names, refs, strict=True)]
    return CaptureSource(path, "bop", lambda: iter(refs), len(refs))


def _scene_refs(
    scene: Path, prefix: str, given: CameraFile | None, options: ReadOptions
) -> list[CaptureRef]:
    files = {kind: _by_image(scene / kind) for kind in ("rgb", "depth", "mask_visib")}
    # A mask or depth picture without its colour picture is a broken frame, not none.
    images = sorted(set().union(*files.values()))
    try:
        cameras = read_json(scene / _CAMERA_FILE)
        if not isinstance(cameras, dict):
            raise CaptureError(
                "is no object of image ids", source=scene / _CAMERA_FILE, remedy="correct the file"
            )
    except CaptureError as error:
        # The other scenes of a data set still load.
        cameras = error
    return [
        CaptureRef(
            f"{prefix}_{image:06d}",
            image,
            partial(
                _load,
                scene,
                f"{prefix}_{image:06d}",
                image,
                {kind: found.get(image, []) for kind, found in files.items()},
                cameras,
                given,
                options.depth_unit_m,
            ),
        )
        for image in images
    ]


def _by_image(folder: Path) -> dict[int, list[Path]]:
    found: dict[int, list[Path]] = {}
    for file in sorted(folder.glob("*")):
        number = file.stem.split("_")[0]
        if file.suffix.lower() in COLOR_SUFFIXES and number.isdecimal():
            found.setdefault(int(number), []).append(file)
    return found


def _load(
    scene: Path,
    name: str,
    image: int,
    files: dict[str, list[Path]],
    cameras: dict[str, Any] | CaptureError,
    given: CameraFile | None,
    unit_m: float | None,
) -> Capture:
    if isinstance(cameras, CaptureError):
        raise cameras
    for kind in ("rgb", "depth"):
        if not files[kind]:
            raise CaptureError(
                f"image {image} is missing, which other files of the scene name",
                source=scene / kind / f"{image:06d}.png",
                remedy="copy the scene again",
            )
    camera = _camera(cameras, image, scene / _CAMERA_FILE)
    color_path, depth_path = files["rgb"][0], files["depth"][0]
    color = read_color(color_path)
    height, width = color.shape[:2]
    raw = read_depth(depth_path)
    require_same_size(color, raw, source=depth_path)
    own = _intrinsics(camera, width, height, scene / _CAMERA_FILE)
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


def _camera(cameras: dict[str, Any], image: int, source: Path) -> _FrameCamera:
    if str(image) not in cameras:
        raise IntrinsicsError(
            f"has no entry for image {image}", source=source, remedy="add its cam_K"
        )
    return parse_model(_FrameCamera, cameras[str(image)], source=source, error=IntrinsicsError)


def _intrinsics(camera: _FrameCamera, width: int, height: int, source: Path) -> Intrinsics:
    try:
        return Intrinsics.from_matrix(camera.cam_K, width, height)
    except IntrinsicsError as error:
        raise IntrinsicsError(error.message, source=source, remedy=error.remedy) from None
