"""Read snapshots of RealSense Viewer: `*_Color.png`, `*_Depth.raw`, `*_Depth_metadata.csv`.

The Viewer exports depth without alignment to colour and without extrinsics, which must be given in
an intrinsics file (`depth_to_color`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cucumbervision import errors
from cucumbervision.capture.camera_file import CameraFile, read_camera_file
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.capture.pictures import read_color
from cucumbervision.capture.readers.common import CameraFinder, frame_capture
from cucumbervision.capture.source import CaptureEntry, CaptureLister, Folder, ReadOptions, fail
from cucumbervision.files import read_bytes

_RAW, _PICTURE, _TABLE = "_Depth.raw", "_Depth.png", "_Depth_metadata.csv"
_YEAR_2001_MS = 1e12
_COLOR, _COLOR_TABLE = "_Color.png", "_Color_metadata.csv"
_ENDINGS = (_COLOR, _RAW, _TABLE, _COLOR_TABLE, _PICTURE)


def find_snapshots(folder: Folder) -> CaptureLister | None:
    """Find the snapshots of a folder.

    A snapshot has raw depth (`.raw`) or its metadata. A colourised depth image next to a colour
    image also counts, so that it is reported. The intrinsics file must have `depth_to_color`; its
    optional `depth` block takes precedence over the metadata.
    """
    snapshots: dict[str, Path | None] = {}
    cameras = CameraFinder(folder)
    for folder_path, names in folder.files.items():
        bases = {n.removesuffix(e) for e in (_RAW, _TABLE) for n in names if n.endswith(e)}
        if bases or any(name.endswith(_COLOR_TABLE) for name in names):
            bases |= {name.removesuffix(_COLOR) for name in names if name.endswith(_COLOR)}
        if bases:
            camera_path = cameras.find(folder_path)
            snapshots |= {
                f"{folder_path}/{base}".lstrip("/"): camera_path for base in sorted(bases)
            }
            snapshot_files = {base + ending for base in bases for ending in _ENDINGS}
            names[:] = [name for name in names if name not in snapshot_files]
    return partial(_open_snapshots, folder.path, snapshots) if snapshots else None


def _open_snapshots(
    path: Path,
    snapshots: Mapping[str, Path | None],
    options: ReadOptions,
    camera_file: CameraFile | None,
) -> Iterator[CaptureEntry]:
    cameras_by_path = {
        file: read_camera_file(file) for file in {*snapshots.values()} if file and not camera_file
    }
    for name, camera_path in snapshots.items():
        camera = camera_file or (cameras_by_path[camera_path] if camera_path else None)
        if camera is None or camera.depth_to_color is None:
            raise errors.IntrinsicsError(
                "RealSense Viewer exports depth as the depth camera sees it, not aligned to colour",
                source=path if camera is None else camera.path,
                remedy="give an intrinsics file with the colour camera and 'depth_to_color'",
            )
        snapshot = _Snapshot(path / name, camera, options)
        try:
            frame = snapshot.table().frame
        except errors.CaptureError as error:
            yield snapshot.base.name, 0, partial(fail, error), snapshot.base, snapshot.parts
        else:
            yield snapshot.base.name, frame, snapshot.load, snapshot.base, snapshot.parts


@dataclass(frozen=True)
class _Snapshot:
    """Files of one snapshot, by their common beginning."""

    base: Path
    camera_file: CameraFile
    options: ReadOptions

    def _file(self, ending: str) -> Path:
        return self.base.with_name(self.base.name + ending)

    def parts(self) -> list[Path | bytes]:
        """Return its files."""
        files = (self._file(ending) for ending in _ENDINGS[:4])
        return [*(file for file in files if file.is_file()), self.camera_file.path]

    def table(self) -> _Table:
        """Read its metadata; refuse a snapshot without raw depth."""
        raw, picture = self._file(_RAW), self._file(_PICTURE)
        if not raw.is_file() and picture.is_file():
            raise errors.DepthError(
                "is the Viewer's colourised picture of depth, which has no distances",
                source=picture,
                remedy=f"export the snapshot with its {raw.name}",
            )
        return _read_metadata(self._file(_TABLE), Stream.DEPTH)

    def load(self, name: str) -> Capture:
        """Read the snapshot."""
        table, raw, color_table = self.table(), self._file(_RAW), self._file(_COLOR_TABLE)
        own = _read_metadata(color_table, Stream.COLOR) if color_table.is_file() else None
        return frame_capture(
            read_color(self._file(_COLOR)),
            partial(_read_raw, raw, table),
            own and own.intrinsics,
            self.camera_file,
            self.options,
            source=raw,
            depth_source=raw,
            depth_camera=table.intrinsics,
            name=name,
            frame=table.frame,
            timestamp_s=table.timestamp_s,
            provenance={"reader": "viewer", "intrinsics": str(self.camera_file.path)},
        )


class _Table(NamedTuple):
    """Metadata of one image: size, intrinsics, number and time."""

    intrinsics: Intrinsics
    format: str
    frame: int
    timestamp_s: float | None


def _read_metadata(path: Path, stream: Stream) -> _Table:
    """Read the metadata file of an image from RealSense Viewer.

    Parameters
    ----------
    path : Path
        `*_metadata.csv` with a key and a value per line.
    stream : Stream
        Stream of the image.

    Raises
    ------
    CaptureError
        If the file, a size or a focal length is missing.

    Notes
    -----
    The metadata contains the lens model but no coefficients; the depth stream of a D4xx is
    rectified and has none.
    """
    lines = read_bytes(path).decode("utf-8", errors="replace").splitlines()
    fields = [line.split(",", 1) for line in lines if "," in line]
    values = {key.strip().lower(): value.strip() for key, value in fields}
    with (
        errors.as_errors_of(path),
        errors.wrap_reader_errors(path, errors.CaptureError, "export it again"),
    ):
        width, height = (int(values[f"resolution {axis}"]) for axis in "xy")
        fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "ppx", "ppy"))
        intrinsics = Intrinsics(width, height, fx, fy, cx, cy, stream)
        milliseconds = float(values.get("timestamp (ms)", "nan"))
        number = int(values.get("frame number", "0"))
    # A hardware clock starts with the camera, not at the epoch.
    time_s = milliseconds / 1000 if milliseconds > _YEAR_2001_MS else None
    return _Table(intrinsics, values.get("format", ""), number, time_s)


def _read_raw(path: Path, table: _Table) -> np.ndarray:
    width, height = table.intrinsics.size
    data, remedy = read_bytes(path), "export the snapshot again, with depth as Z16"
    if table.format and table.format.upper() != "Z16":
        raise errors.DepthError(f"holds {table.format}, not Z16", source=path, remedy=remedy)
    if len(data) != 2 * width * height:
        size = f"{width}x{height} of 16 bits are {2 * width * height}"
        raise errors.DepthError(f"has {len(data)} bytes, but {size}", source=path, remedy=remedy)
    return np.frombuffer(data, "<u2").reshape(height, width)
