"""Read and write native capture folders: `capture.json`, images and masks."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from cucumbervision.arrays import Array, Array32, Pixels
from cucumbervision.capture.camera_file import CameraFile, CameraModel, StrictModel
from cucumbervision.capture.frames import Capture, FusedBurst, Stop, depth_along_axis, fuse_burst
from cucumbervision.capture.intrinsics import MASKS, DepthAlong
from cucumbervision.capture.pictures import (
    MOST_BURST_PIXELS,
    depth_to_metres,
    read_color,
    read_depth,
    read_masks,
    require_readings,
    write_png,
)
from cucumbervision.capture.readers.common import choose_intrinsics, require_same_size
from cucumbervision.capture.source import CaptureEntry, CaptureLister, Folder, ReadOptions, fail
from cucumbervision.errors import CaptureError, as_errors_of, wrap_os_errors
from cucumbervision.files import json_value, parse_model, read_json, write_bytes

FORMAT = "cucumbervision-capture"

MANIFEST = "capture.json"


def _inside(name: str) -> str:
    # Capture folders may be untrusted, so file names must not leave the folder.
    if PureWindowsPath(name).is_absolute() or name.startswith(("/", "\\")) or ".." in name:
        raise ValueError("must be a file in the capture's folder")
    return name


_Whole = Annotated[int, Field(ge=0, lt=2**63)]
_Share = Annotated[float, Field(ge=-1, le=1)]
_File = Annotated[str, Field(min_length=1), AfterValidator(_inside)]


class _Frame(StrictModel):
    """One frame of a burst: file names relative to the folder."""

    color: _File
    depth: _File
    timestamp_s: float | None = Field(default=None, ge=0, le=2e11)


class _Stop(StrictModel):
    """Position in the greenhouse."""

    row: str | None = None
    side: str | None = None
    position_m: float | None = Field(default=None, ge=-1e6, le=1e6)
    step: _Whole | None = None


class Manifest(StrictModel):
    """Contents of `capture.json`; `docs/captures.md` describes every key."""

    format: Literal["cucumbervision-capture"]
    version: Literal[1]
    frames: list[_Frame] = Field(min_length=1)
    camera: CameraModel
    depth_unit_m: float = Field(default=0.001, gt=0)
    depth_rounding_m: float = Field(default=0.0, ge=0)
    name: str | None = None
    frame: _Whole = 0
    burst_frame: _Whole = 0
    burst_size: int = Field(default=1, ge=1, lt=2**63)
    stop: _Stop = Field(default_factory=_Stop)
    simulated: bool = False
    provenance: dict[str, Any] = Field(default_factory=dict)
    gravity: tuple[_Share, _Share, _Share] | None = None


def find_native(folder: Folder) -> CaptureLister | None:
    """Find native capture folders; given intrinsics replace those of the folder."""
    folders = folder.take(MANIFEST, "", MASKS)
    return partial(_open_folders, folder.path, [*folders]) if folders else None


def read_native(folder: Path) -> Capture:
    """Read a native capture folder as `write_native` wrote it."""
    manifest = parse_model(Manifest, read_json(folder / MANIFEST), source=folder / MANIFEST)
    return _Files(folder, manifest, ReadOptions(), None).load(manifest.name or folder.name)


def _open_folders(
    path: Path, folders: Sequence[str], options: ReadOptions, camera_file: CameraFile | None
) -> Iterator[CaptureEntry]:
    for subfolder in folders:
        folder = path / subfolder
        name = "_".join(Path(subfolder).parts or (path.resolve().name,))
        source = folder / MANIFEST
        try:
            manifest = parse_model(Manifest, read_json(source), source=source)
        except CaptureError as error:
            yield name, 0, partial(fail, error), source, None
        else:
            files = _Files(folder, manifest, options, camera_file)
            yield manifest.name or name, manifest.frame, files.load, source, files.parts


@dataclass(frozen=True)
class _Files:
    """Files of one native capture."""

    folder: Path
    manifest: Manifest
    options: ReadOptions
    camera_file: CameraFile | None

    def parts(self) -> list[Path | bytes]:
        """Return its files."""
        names = [name for frame in self.manifest.frames for name in (frame.color, frame.depth)]
        camera_files = [] if self.camera_file is None else [self.camera_file.path]
        masks = sorted((self.folder / MASKS).glob("*.png"))
        return [*(self.folder / name for name in (MANIFEST, *names)), *masks, *camera_files]

    def load(self, name: str) -> Capture:
        """Read the capture."""
        folder, manifest, options = self.folder, self.manifest, self.options
        unit_m = options.depth_unit_m or manifest.depth_unit_m
        options = options.with_camera(self.camera_file)
        frames = []
        for frame in manifest.frames:
            color, raw = read_color(folder / frame.color), read_depth(folder / frame.depth)
            require_same_size(color, raw, source=folder / frame.depth)
            if raw.size * len(manifest.frames) > MOST_BURST_PIXELS:
                most = f"{MOST_BURST_PIXELS / 1e6:g} million pixels"
                fault, remedy = f"its frames have more than {most} together", "give shorter bursts"
                raise CaptureError(fault, source=folder / MANIFEST, remedy=remedy)
            frames.append((color, depth_to_metres(raw, unit_m, source=folder / frame.depth)))
        # Depth of a single frame is not fused, so that reading returns what was written.
        fused, number = FusedBurst(*frames[0], manifest.burst_frame, manifest.burst_size), 0
        if len(frames) > 1:
            with as_errors_of(folder):
                fused = fuse_burst(*zip(*frames, strict=True))
            number = fused.burst_frame
        height, width = fused.depth_m.shape
        path, aligned_to = folder / MANIFEST, options.aligned_to
        with as_errors_of(path):
            own = manifest.camera.intrinsics
        intrinsics = choose_intrinsics(
            own, self.camera_file, width, height, aligned_to=aligned_to, source=path
        )
        if options.depth_along is DepthAlong.RAY:
            fused = replace(fused, depth_m=depth_along_axis(fused.depth_m, intrinsics))
        require_readings(fused.depth_m, source=folder)
        return Capture(
            **vars(fused),
            intrinsics=intrinsics,
            name=name,
            frame=manifest.frame,
            masks=read_masks(_masks(folder, manifest.frame), fused.color.shape),
            stop=Stop(**manifest.stop.model_dump()),
            timestamp_s=manifest.frames[number].timestamp_s,
            simulated=manifest.simulated,
            source=str(folder),
            provenance=manifest.provenance,
            gravity=manifest.gravity,
        )


def _masks(folder: Path, frame: int) -> list[Path]:
    paths = sorted((folder / MASKS).glob("*.png"))
    for path in paths:
        number = path.stem.split("_")[0]
        if not number.isdecimal() or int(number) != frame:
            fault = f"the mask is named for frame {number}, the capture is frame {frame}"
            remedy = f"name it {frame:06d}_000000.png, or set 'frame' in {MANIFEST}"
            raise CaptureError(fault, source=path, remedy=remedy)
    return paths


# Depth units to try, from coarse to fine; 16 bits of the finest reach 3.3 m.
_UNITS_M = (0.001, 0.0005, 0.00025, 0.0001, 0.00005)

_STEPS = 65535

_EXACT_M = 5e-7


def write_native(
    capture: Capture,
    folder: Path,
    *,
    burst: Sequence[tuple[Pixels, Array32]] = (),
    timestamps_s: Sequence[float | None] = (),
) -> Path:
    """Write a capture as a native folder without loss.

    Parameters
    ----------
    capture : Capture
        The capture; name, frame, stop, masks, intrinsics and provenance are included.
    folder : Path
        Output folder; created if missing, must not contain a capture.
    burst : sequence of (color, depth_m), optional
        Frames of the burst, written instead of the fused image and fused again when read: colour
        uint8 (H, W, 3), depth float32 (H, W) in metres.
    timestamps_s : sequence of float, optional
        Timestamps of the frames, seconds since the epoch.

    Returns
    -------
    Path
        The `capture.json`, which is written last, so that an interrupted write leaves no capture.

    Raises
    ------
    CaptureError
        If the folder already contains a capture or is not writable, or depth exceeds 65.5 m.

    Notes
    -----
    Depth is written as 16-bit PNG in steps of 1 mm, or in finer steps if 1 mm would round values (a
    burst's median may lie between two millimetres). If even the finest possible step (0.05 mm up to
    3.3 m, 0.1 mm up to 6.5 m) rounds values, `capture.json` states the maximum error as
    `depth_rounding_m`.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth = np.full((48, 64), 0.4545, np.float32)
    >>> color, camera = np.zeros((48, 64, 3), np.uint8), Intrinsics(64, 48, 60, 60, 32, 24)
    >>> with tempfile.TemporaryDirectory() as tmp:
    ...     path = write_native(Capture(color, depth, camera, "a"), pathlib.Path(tmp) / "a")
    ...     capture_read = read_native(path.parent)
    >>> capture_read.name, bool((capture_read.depth_m == depth).all())
    ('a', True)
    """
    if (folder / MANIFEST).exists():
        raise CaptureError("already holds a capture", source=folder, remedy="choose another folder")
    frames = list(burst) or [(capture.color, capture.depth_m)]
    times = list(timestamps_s) or ([None] * len(burst) if burst else [capture.timestamp_s])
    unit_m, rounding_m = _choose_unit([d for _, d in frames], folder)
    manifest = {
        "format": FORMAT,
        "version": 1,
        "name": capture.name,
        "frame": capture.frame,
        "burst_frame": 0 if burst else capture.burst_frame,
        "burst_size": 1 if burst else capture.burst_size,
        "frames": [
            {"color": f"color_{i:06d}.png", "depth": f"depth_{i:06d}.png", "timestamp_s": t}
            for i, t in enumerate(times)
        ],
        "depth_unit_m": unit_m,
        "depth_rounding_m": rounding_m,
        "camera": CameraModel.of(capture.intrinsics).model_dump(mode="json"),
        "stop": vars(capture.stop),
        "simulated": capture.simulated,
        "provenance": dict(capture.provenance),
        **({} if capture.gravity is None else {"gravity": list(capture.gravity)}),
    }
    parse_model(Manifest, manifest := json_value(manifest), source=folder)
    with wrap_os_errors("cannot be made", folder, "choose another folder", CaptureError):
        (folder / MASKS if capture.masks else folder).mkdir(parents=True, exist_ok=True)
    for i, (color, depth_m) in enumerate(frames):
        write_png(folder / f"color_{i:06d}.png", color)
        write_png(folder / f"depth_{i:06d}.png", _steps(depth_m, unit_m).astype(np.uint16))
    for k, mask in enumerate(capture.masks):
        write_png(folder / MASKS / f"{capture.frame:06d}_{k:06d}.png", mask.astype(np.uint8) * 255)
    write_bytes(folder / MANIFEST, (json.dumps(manifest, indent=2) + "\n").encode())
    return folder / MANIFEST


def _choose_unit(depths_m: Sequence[Array32], folder: Path) -> tuple[float, float]:
    readings = np.unique(np.concatenate([d[np.isfinite(d) & (d > 0)].ravel() for d in depths_m]))
    far_m = float(readings.max(initial=0.0))
    units_m = [unit_m for unit_m in _UNITS_M if far_m / unit_m <= _STEPS]
    if not units_m:
        raise CaptureError(
            f"depth reaches {far_m:.0f} m, too far for 16 bits in millimetres",
            source=folder,
            remedy="set readings beyond 65.5 m to 0",
        )
    for unit_m in units_m:
        rounding_m = float(np.abs(_steps(readings, unit_m) * unit_m - readings).max(initial=0.0))
        if rounding_m < _EXACT_M:
            break
    return unit_m, round(rounding_m, 6)


def _steps(depth_m: Array32, unit_m: float) -> Array:
    finite = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0)
    return np.rint(finite.astype(np.float64) / unit_m)
