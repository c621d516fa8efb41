"""Snapshots that RealSense Viewer exports: `*_Color.png`, `*_Depth.raw`, `*_Depth_metadata.csv`.

The Viewer saves depth as the depth camera sees it, and no extrinsics: those come with the user's
intrinsics file (`depth_to_color`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.depth import depth_to_metres, require_readings
from cucumbervision.capture.files import read_bytes, read_color
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Distortion, Intrinsics, Stream
from cucumbervision.capture.readers.common import (
    aligned_depth,
    choose_intrinsics,
    given_calibration,
)
from cucumbervision.capture.source import (
    CaptureRef,
    CaptureSource,
    ReadOptions,
    safe_name,
    unique_names,
)
from cucumbervision.errors import CaptureError, DepthError, IntrinsicsError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from cucumbervision.capture.camera_file import CameraFile

__all__ = ["Snapshot", "find_snapshots", "open_viewer", "read_metadata"]

_RAW, _PICTURE, _TABLE = "_Depth.raw", "_Depth.png", "_Depth_metadata.csv"
_YEAR_2001_MS = 1e12
_COLOR, _COLOR_TABLE = "_Color.png", "_Color_metadata.csv"


@dataclass(frozen=True)
class Snapshot:
    """What one frame's table says: size, lens, number and time."""

    intrinsics: Intrinsics
    format: str
    frame: int
    timestamp_s: float | None


def find_snapshots(path: Path) -> list[Path]:
    """Return the exports in a folder, as paths without their endings.

    A folder counts when it has depth as numbers (`.raw`) or its table; a colourised picture of
    depth counts beside a colour picture of the Viewer's name, so that it can be refused.
    """
    bases = {
        file.name.removesuffix(ending)
        for ending in (_RAW, _TABLE)
        for file in path.glob(f"*{ending}")
    }
    if bases or any(path.glob(f"*{_COLOR_TABLE}")):
        bases |= {f.name.removesuffix(_COLOR) for f in path.glob(f"*{_COLOR}")}
    return [path / base for base in sorted(bases)]


def open_viewer(path: Path, bases: Sequence[Path], options: ReadOptions) -> CaptureSource:
    """Open RealSense Viewer's exports.

    Parameters
    ----------
    path : Path
        The folder.
    bases : sequence of Path
        From `find_snapshots`.
    options : ReadOptions
        The intrinsics file must have `depth_to_color`; its `depth` block, if there is one, goes
        before the snapshot's own table.

    Raises
    ------
    IntrinsicsError
        If there is no intrinsics file, or it has no `depth_to_color`.
    """
    given = given_calibration(options)
    if given is None or given.depth_to_color is None:
        raise IntrinsicsError(
            "RealSense Viewer exports depth as the depth camera sees it, not aligned to colour",
            source=path if given is None else given.path,
            remedy="give an intrinsics file with the colour camera and 'depth_to_color'",
        )
    names = unique_names(safe_name(base.name) for base in bases)
    refs = []
    for name, base in zip(names, bases, strict=True):
        table = _table_or_error(base.with_name(base.name + _TABLE))
        frame = 0 if isinstance(table, CaptureError) else table.frame
        load = partial(_load, base, name, table, given, options.depth_unit_m)
        refs.append(CaptureRef(name, frame, load))
    return CaptureSource(path, "viewer", lambda: iter(refs), len(refs))


def _table_or_error(path: Path) -> Snapshot | CaptureError:
    try:
        return read_metadata(path, Stream.DEPTH)
    except CaptureError as error:
        return error


def _load(
    base: Path,
    name: str,
    table: Snapshot | CaptureError,
    given: CameraFile,
    unit_m: float | None,
) -> Capture:
    raw_path = base.with_name(base.name + _RAW)
    if not raw_path.is_file() and base.with_name(base.name + _PICTURE).is_file():
        raise DepthError(
            "is the Viewer's colourised picture of depth, which has no distances",
            source=base.with_name(base.name + _PICTURE),
            remedy=f"export the snapshot with its {raw_path.name}",
        )
    if isinstance(table, CaptureError):
        raise table
    color = read_color(base.with_name(base.name + _COLOR))
    height, width = color.shape[:2]
    own_path = base.with_name(base.name + _COLOR_TABLE)
    own = read_metadata(own_path, Stream.COLOR).intrinsics if own_path.is_file() else None
    intrinsics = choose_intrinsics(own, given, width, height, source=base)
    depth_m = depth_to_metres(
        _read_raw(raw_path, table), unit_m or given.depth_unit_m, source=raw_path
    )
    depth_m = aligned_depth(
        depth_m, color, intrinsics, given, source=raw_path, depth_camera=table.intrinsics
    )
    require_readings(depth_m, source=raw_path)
    return Capture(
        color,
        depth_m,
        intrinsics,
        name,
        frame=table.frame,
        timestamp_s=table.timestamp_s,
        source=str(raw_path),
        provenance={"reader": "viewer", "intrinsics": str(given.path)},
    )


def read_metadata(path: Path, stream: Stream) -> Snapshot:
    """Read the table that RealSense Viewer writes beside each picture.

    Parameters
    ----------
    path : Path
        `*_metadata.csv`: a key and a value a line.
    stream : Stream
        Whose table it is.

    Raises
    ------
    CaptureError
        If it is missing, or a size or focal length is.

    Notes
    -----
    The table names the lens model but not its coefficients; a D4xx depth stream is rectified
    and has none.
    """
    lines = read_bytes(path).decode("utf-8", errors="replace").splitlines()
    fields = [line.split(",", 1) for line in lines if "," in line]
    values = {key.strip().lower(): value.strip() for key, value in fields}
    try:
        intrinsics = Intrinsics(
            int(values["resolution x"]),
            int(values["resolution y"]),
            float(values["fx"]),
            float(values["fy"]),
            float(values["ppx"]),
            float(values["ppy"]),
            stream,
            Distortion.NONE,
        )
        milliseconds = float(values.get("timestamp (ms)", "nan"))
        number = int(values.get("frame number", "0"))
    except (KeyError, ValueError) as error:
        what = f"has no '{error.args[0]}'" if isinstance(error, KeyError) else "holds no number"
        raise CaptureError(
            f"is no table of RealSense Viewer: it {what}", source=path, remedy="export it again"
        ) from None
    except IntrinsicsError as error:
        raise IntrinsicsError(error.message, source=path, remedy="export it again") from None
    # A hardware clock counts from the camera's start, not from the epoch.
    time_s = milliseconds / 1000 if milliseconds > _YEAR_2001_MS else None
    return Snapshot(intrinsics, values.get("format", ""), number, time_s)


def _read_raw(path: Path, table: Snapshot) -> np.ndarray:
    width, height = table.intrinsics.size
    data = read_bytes(path)
    if table.format and table.format.upper() != "Z16":
        raise DepthError(
            f"holds {table.format}, not Z16", source=path, remedy="export the depth stream as Z16"
        )
    if len(data) != 2 * width * height:
        raise DepthError(
            f"has {len(data)} bytes, but {width}x{height} of 16 bits are {2 * width * height}",
            source=path,
            remedy="export the snapshot again",
        )
    return np.frombuffer(data, "<u2").reshape(height, width)
