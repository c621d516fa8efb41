"""Recordings of a RealSense camera (`.bag`, `.db3`), played back through the SDK itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from cucumbervision.capture.cameras.realsense_sdk import (
    AlignedFrame,
    AlignedStream,
    import_realsense,
    play_file,
)
from cucumbervision.capture.depth import require_readings
from cucumbervision.capture.frames import Capture, fuse_burst
from cucumbervision.capture.readers.common import choose_intrinsics, given_calibration
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, safe_name
from cucumbervision.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from cucumbervision.capture.intrinsics import Intrinsics

__all__ = ["open_recording"]

_TIMEOUT_S = 5.0


def open_recording(path: Path, options: ReadOptions) -> CaptureSource:
    """Open a recording, cut into consecutive bursts of `options.burst` frames.

    Parameters
    ----------
    path : Path
        `.bag` or `.db3`.
    options : ReadOptions
        Burst length, and intrinsics that replace the recording's own if the guard lets them
        pass. The depth unit is the recording's.

    Returns
    -------
    CaptureSource
        Of unknown length. Each iteration plays the file once, from its beginning; it is
        released when the iteration ends or is dropped. The last burst may be shorter.

    Raises
    ------
    MissingExtraError
        If pyrealsense2 is not installed.
    CaptureError
        If the file is no recording with colour and depth.
    """
    import_realsense()
    given = given_calibration(options)
    with _stream(path) as stream:
        own, device = stream.intrinsics, stream.device
    intrinsics = choose_intrinsics(own, given, own.width, own.height, source=path)
    recording = _Recording(path, intrinsics, device)
    return CaptureSource(path, "recording", lambda: _refs(recording, options.burst))


@dataclass(frozen=True)
class _Recording:
    path: Path
    intrinsics: Intrinsics
    device: dict[str, str]


def _stream(path: Path) -> AlignedStream:
    return AlignedStream(play_file(path), source=path, playback=True, timeout_s=_TIMEOUT_S)


def _refs(recording: _Recording, burst: int) -> Iterator[CaptureRef]:
    name = safe_name(recording.path.stem)
    fault, any_frame = None, False
    with _stream(recording.path) as stream:
        while fault is None:
            frames, fault = _next_burst(stream, burst)
            if not frames:
                break
            any_frame = True
            yield _ref(recording, f"{name}_{frames[0].number:06d}", frames)
    if fault is None and not any_frame:
        fault = CaptureError(
            "has no frame with both colour and depth",
            source=recording.path,
            remedy="record both streams at one rate",
        )
    if fault is not None:
        # What came before a break is whole; the break itself is a capture that fails.
        yield CaptureRef(f"{name}_end", -1, partial(_fail, fault))


def _next_burst(
    stream: AlignedStream, burst: int
) -> tuple[list[AlignedFrame], CaptureError | None]:
    frames: list[AlignedFrame] = []
    while len(frames) < burst:
        try:
            frame = stream.read()
        except CaptureError as fault:
            # It is kept longer than the pipeline, which its traceback would hold on to.
            return frames, fault.with_traceback(None)
        if frame is None:
            break
        # A colour stream that is slower than depth comes again with each new depth.
        if not frames or frame.number != frames[-1].number:
            frames.append(frame)
    return frames, None


def _fail(fault: CaptureError) -> Capture:
    raise fault


def _ref(recording: _Recording, name: str, frames: list[AlignedFrame]) -> CaptureRef:
    number = frames[0].number

    def load() -> Capture:
        color, depth_m, kept = fuse_burst([f.color for f in frames], [f.depth_m for f in frames])
        require_readings(depth_m, source=f"{recording.path} frame {number}")
        return Capture(
            color,
            depth_m,
            recording.intrinsics,
            name,
            frame=number,
            burst_frame=kept,
            burst_size=len(frames),
            timestamp_s=frames[kept].timestamp_s,
            source=str(recording.path),
            provenance={"reader": "recording", **recording.device},
        )

    return CaptureRef(name, number, load)
