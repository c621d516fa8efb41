"""The project's own capture folder: `capture.json`, pictures, and masks where there are any."""

from __future__ import annotations

from functools import partial
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.depth import depth_to_metres, require_readings
from cucumbervision.capture.files import (
    parse_model,
    read_color,
    read_depth,
    read_json,
    read_mask,
)
from cucumbervision.capture.frames import Capture, Stop, fuse_burst
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
from cucumbervision.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.capture.camera_file import CameraFile

__all__ = ["FORMAT", "MANIFEST", "MASKS", "Frame", "Manifest", "find_captures", "open_native"]

FORMAT = "cucumbervision-capture"
MANIFEST = "capture.json"
MASKS = "mask_visib"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def _inside(name: str) -> str:
    # A capture folder may come from anyone; it must not name files elsewhere.
    if PureWindowsPath(name).is_absolute() or name.startswith(("/", "\\")) or ".." in name:
        raise ValueError("must be a file in the capture's folder")
    return name


_File = Annotated[str, Field(min_length=1), AfterValidator(_inside)]


class Frame(_Strict):
    """One frame of a burst: file names relative to the folder."""

    color: _File
    depth: _File
    timestamp_s: float | None = None


class StopModel(_Strict):
    """Where in the house it was taken."""

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    step: int | None = None


class Manifest(_Strict):
    """What `capture.json` holds; `docs/captures.md` describes every key."""

    format: Literal["cucumbervision-capture"]
    version: Literal[1]
    frames: list[Frame] = Field(min_length=1)
    camera: CameraModel
    depth_unit_m: float = Field(default=0.001, gt=0)
    depth_rounding_m: float = Field(default=0.0, ge=0)
    name: str | None = None
    frame: int = Field(default=0, ge=0)
    burst_frame: int = Field(default=0, ge=0)
    burst_size: int = Field(default=1, ge=1)
    stop: StopModel = Field(default_factory=StopModel)
    simulated: bool = False
    provenance: dict[str, Any] = Field(default_factory=dict)


def find_captures(path: Path) -> list[Path]:
    """Return the native captures in a folder: itself, or every one below it, in order."""
    if (path / MANIFEST).is_file():
        return [path]
    return sorted(p.parent for p in path.rglob(MANIFEST))


def open_native(path: Path, folders: Sequence[Path], options: ReadOptions) -> CaptureSource:
    """Open native capture folders.

    Parameters
    ----------
    path : Path
        What the user named.
    folders : sequence of Path
        From `find_captures`.
    options : ReadOptions
        The user's intrinsics replace the folder's if the guard lets them pass.

    Raises
    ------
    CaptureError
        If the user's intrinsics file cannot be read.
    """
    given = given_calibration(options)
    found = [_manifest_or_error(folder) for folder in folders]
    names = unique_names(
        _name_of(path, folder, manifest) for folder, manifest in zip(folders, found, strict=True)
    )
    refs = [
        CaptureRef(
            name,
            0 if isinstance(manifest, CaptureError) else manifest.frame,
            partial(_load, folder, manifest, name, given, options.depth_unit_m),
        )
        for name, folder, manifest in zip(names, folders, found, strict=True)
    ]
    return CaptureSource(path, "native", lambda: iter(refs), len(refs))


def _manifest_or_error(folder: Path) -> Manifest | CaptureError:
    source = folder / MANIFEST
    try:
        return parse_model(Manifest, read_json(source), source=source)
    except CaptureError as error:
        return error


def _name_of(path: Path, folder: Path, manifest: Manifest | CaptureError) -> str:
    if isinstance(manifest, Manifest) and manifest.name:
        return safe_name(manifest.name)
    parts = folder.relative_to(path).parts or (path.resolve().name,)
    return safe_name("_".join(parts))


def _load(
    folder: Path,
    manifest: Manifest | CaptureError,
    name: str,
    given: CameraFile | None,
    unit_m: float | None,
) -> Capture:
    if isinstance(manifest, CaptureError):
        raise manifest
    frames = [_read_frame(folder, f, unit_m or manifest.depth_unit_m) for f in manifest.frames]
    if len(frames) == 1:
        # A single frame's depth stays as it is, so that what was written is what is read.
        (color, depth_m), burst_frame = frames[0], manifest.burst_frame
        burst_size = manifest.burst_size
    else:
        try:
            color, depth_m, burst_frame = fuse_burst([c for c, _ in frames], [d for _, d in frames])
        except CaptureError as error:
            raise CaptureError(error.message, source=folder, remedy=error.remedy) from None
        burst_size = len(frames)
    height, width = color.shape[:2]
    intrinsics = choose_intrinsics(
        manifest.camera.intrinsics, given, width, height, source=folder / MANIFEST
    )
    require_readings(depth_m, source=folder)
    kept = manifest.frames[burst_frame if len(frames) > 1 else 0]
    return Capture(
        color,
        depth_m,
        intrinsics,
        name,
        frame=manifest.frame,
        burst_frame=burst_frame,
        burst_size=burst_size,
        masks=_read_masks(folder, manifest.frame, color.shape),
        stop=Stop(**manifest.stop.model_dump()),
        timestamp_s=kept.timestamp_s,
        simulated=manifest.simulated,
        source=str(folder),
        provenance=manifest.provenance,
    )


def _read_frame(
    folder: Path, frame: Frame, unit_m: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    color_path, depth_path = folder / frame.color, folder / frame.depth
    color, raw = read_color(color_path), read_depth(depth_path)
    require_same_size(color, raw, source=depth_path)
    return color, depth_to_metres(raw, unit_m, source=depth_path)


def _read_masks(folder: Path, frame: int, shape: tuple[int, ...]) -> tuple[NDArray[np.bool_], ...]:
    masks = []
    for path in sorted((folder / MASKS).glob("*.png")):
        number = path.stem.split("_")[0]
        if not number.isdecimal() or int(number) != frame:
            raise CaptureError(
                f"the mask is named for frame {number}, the capture is frame {frame}",
                source=path,
                remedy=f"name it {frame:06d}_000000.png, or set 'frame' in {MANIFEST}",
            )
        masks.append(read_mask(path, shape))
    return tuple(masks)
