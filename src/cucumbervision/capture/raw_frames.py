"""Uncompressed frames on disk, one file per frame, and a ring of the newest frames.

A file is a JSON header and the arrays as they lie in memory. It is renamed into place when it is
complete, so that a killed program leaves none that is cut off.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.depth import scale_depth
from cucumbervision.capture.frames import Capture, Doubt, Stop
from cucumbervision.errors import CaptureError, wrap_os_errors
from cucumbervision.files import json_value

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

SUFFIX = ".frame"
_MAGIC = b"cucumbervision frame 1\n"
_UNIT_M = 0.001  # of almost every camera; depth then needs half the space
_HEADER_BYTES = 1 << 16
_RESERVE_BYTES = 500_000_000  # free disk space reserved for saved captures
_TEMPORARY = ".unfinished-"


def write_frame(capture: Capture, path: Path) -> None:
    """Write a capture without its masks as raw arrays, atomically.

    Depth is written as 16-bit millimetres if that is exact, otherwise as float32 metres.

    Raises
    ------
    CaptureError
        If it cannot be written.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth = np.full((48, 64), 0.4545, np.float32)
    >>> color, camera = np.zeros((48, 64, 3), np.uint8), Intrinsics(64, 48, 60, 60, 32, 24)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "a.frame"
    ...     write_frame(Capture(color, depth, camera, "a"), path)
    ...     capture_read = read_frame(path)
    >>> capture_read.name, bool((capture_read.depth_m == depth).all())
    ('a', True)
    """
    depth, unit_m = _coded(capture.depth_m)
    header = {
        "shape": capture.depth_m.shape,
        "unit_m": unit_m,
        "name": capture.name,
        "frame": capture.frame,
        "burst_frame": capture.burst_frame,
        "burst_size": capture.burst_size,
        "moved_px": capture.moved_px,
        "stop": asdict(capture.stop),
        "timestamp_s": capture.timestamp_s,
        "simulated": capture.simulated,
        "source": capture.source,
        "provenance": dict(capture.provenance),
        "gravity": capture.gravity,
        "doubts": capture.doubts,
        "camera": CameraModel.of(capture.intrinsics).model_dump(mode="json"),
    }
    text = json.dumps(json_value(header)).encode()
    half = path.with_name(f"{_TEMPORARY}{path.name}")
    remedy = "free some space on the disk, and check its rights"
    try:
        with wrap_os_errors("cannot be written", path, remedy, CaptureError):
            with half.open("wb") as stream:
                stream.write(_MAGIC + len(text).to_bytes(4, "little") + text)
                stream.write(np.ascontiguousarray(capture.color).data)
                stream.write(np.ascontiguousarray(depth).data)
            half.rename(path)
    except BaseException:
        half.unlink(missing_ok=True)
        raise


def read_frame(path: Path) -> Capture:
    """Read a frame.

    Raises
    ------
    CaptureError
        If it cannot be read, or is damaged.
    """
    remedy = "press again"
    with wrap_os_errors("cannot be read", path, remedy, CaptureError):
        content = path.read_bytes()
    start = len(_MAGIC) + 4
    size = int.from_bytes(content[len(_MAGIC) : start], "little")
    try:
        if not content.startswith(_MAGIC) or size > _HEADER_BYTES:
            raise ValueError("it has no header")
        header = json.loads(content[start : start + size])
        height, width = header.pop("shape")
        unit_m, pixels = header.pop("unit_m"), height * width
        kind = np.dtype(np.uint16 if unit_m else np.float32)
        if len(content) - start - size != pixels * (3 + kind.itemsize):
            raise ValueError("it is cut off")
        color = np.frombuffer(content, np.uint8, 3 * pixels, start + size)
        depth = np.frombuffer(content, kind, pixels, start + size + 3 * pixels)
        depth_m = scale_depth(depth, unit_m) if unit_m else depth.astype(np.float32)
        stop, gravity = Stop(**header.pop("stop")), header.pop("gravity")
        doubts = tuple(Doubt(name) for name in header.pop("doubts"))
        return Capture(
            color.reshape(height, width, 3).copy(),
            depth_m.reshape(height, width),
            CameraModel.model_validate(header.pop("camera")).intrinsics,
            stop=stop,
            gravity=None if gravity is None else tuple(gravity),
            doubts=doubts,
            **header,
        )
    except (ValueError, TypeError, KeyError) as error:
        raise CaptureError(f"is no whole frame ({error})", source=path, remedy=remedy) from None


def _coded(depth_m: NDArray[np.float32]) -> tuple[NDArray[Any], float]:
    """Return depth as 16-bit millimetres and their unit; unchanged and 0 if inexact."""
    steps = np.nan_to_num(np.rint(depth_m / np.float32(_UNIT_M)), nan=-1.0, posinf=-1.0)
    if steps.min(initial=0.0) < 0 or steps.max(initial=0.0) > np.iinfo(np.uint16).max:
        return depth_m, 0.0
    coded = steps.astype(np.uint16)
    exact = np.array_equal(scale_depth(coded, _UNIT_M), depth_m)
    return (coded, _UNIT_M) if exact else (depth_m, 0.0)


@dataclass(frozen=True)
class RingFrame:
    """A frame in a ring: when it was taken, seconds since 1970, and its file."""

    at_s: float
    path: Path

    def load(self) -> Capture:
        """Return the frame.

        Raises
        ------
        CaptureError
            If it has left the ring.
        """
        return read_frame(self.path)


class FrameRing:
    """The newest frames of a camera in a folder: one program writes, others read.

    Parameters
    ----------
    folder : Path
        Folder; created with the first frame.
    kept_s : float
        Maximum age of a frame, seconds.
    dense_s, sparse_s : float
        All frames are kept for `dense_s`, older ones one per `sparse_s`, seconds.
    most_bytes : int
        Maximum size of all frames, less if the disk is almost full; the oldest are removed first.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth, color = np.full((48, 64), 0.5, np.float32), np.zeros((48, 64, 3), np.uint8)
    >>> capture = Capture(color, depth, Intrinsics(64, 48, 60, 60, 32, 24), "a")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     ring = FrameRing(pathlib.Path(folder), kept_s=2.0, dense_s=0.5, sparse_s=1.0)
    ...     for at_s in (7.0, 8.1, 9.0, 9.2, 9.6, 10.0):
    ...         ring.write(capture, at_s, now_s=at_s)
    ...     [frame.at_s for frame in ring.frames()]
    [8.1, 9.2, 9.6, 10.0]
    """

    def __init__(
        self,
        folder: Path,
        *,
        kept_s: float = 90.0,
        dense_s: float = 3.0,
        sparse_s: float = 0.25,
        most_bytes: int = 2_000_000_000,
    ) -> None:
        self.folder, self.kept_s = folder, kept_s
        self._dense_s, self._sparse_s, self._most_bytes = dense_s, sparse_s, most_bytes
        self._held: list[tuple[float, int]] | None = None  # times and sizes, only in the writer

    def write(self, capture: Capture, at_s: float, *, now_s: float | None = None) -> None:
        """Add a frame, and remove frames that are too old.

        Raises
        ------
        CaptureError
            If it cannot be written.
        """
        if self._held is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            for half in self.folder.glob(f"{_TEMPORARY}*"):
                half.unlink(missing_ok=True)
            self._held = [(frame.at_s, frame.path.stat().st_size) for frame in self.frames()]
        self._thin(time.time() if now_s is None else now_s)
        path = self._path(at_s)
        write_frame(capture, path)
        self._held.append((_time_of(path), path.stat().st_size))

    def frames(self) -> list[RingFrame]:
        """Return the frames, the oldest first."""
        with suppress(FileNotFoundError), os.scandir(self.folder) as entries:
            paths = [self.folder / entry.name for entry in entries if entry.name.endswith(SUFFIX)]
            times = ((_time_of(path), path) for path in paths if path.stem.isdecimal())
            return [RingFrame(*entry) for entry in sorted(times)]
        return []

    def _thin(self, now_s: float) -> None:
        held = sorted(self._held or [])
        free_bytes = self._room_bytes(sum(size for _, size in held))
        frames_kept: list[tuple[float, int]] = []
        last_s = -math.inf
        for at_s, size in held:
            is_new = now_s - at_s <= self._dense_s
            # After the clock is set back, frames with later times would be kept too long.
            is_current = abs(now_s - at_s) <= self.kept_s and free_bytes >= 0
            if is_current and (is_new or at_s - last_s >= self._sparse_s):
                frames_kept.append((at_s, size))
                last_s = at_s
            else:
                self._path(at_s).unlink(missing_ok=True)
                free_bytes += size
        self._held = frames_kept

    def _room_bytes(self, held_bytes: int) -> int:
        """Return how many bytes the ring may still use; negative if it must shrink."""
        disk_bytes = shutil.disk_usage(self.folder).free - _RESERVE_BYTES
        return min(self._most_bytes - held_bytes, disk_bytes)

    def _path(self, at_s: float) -> Path:
        return self.folder / f"{round(1e6 * at_s):016d}{SUFFIX}"


def _time_of(path: Path) -> float:
    return int(path.stem) / 1e6
