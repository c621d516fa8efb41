"""Read recordings of a RealSense camera (`.bag`, `.db3`) through the SDK."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from cucumbervision.capture import realsense
from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.intrinsics import DepthAlong, Intrinsics, Stream
from cucumbervision.capture.readers.common import choose_intrinsics
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, fail, safe_name
from cucumbervision.errors import CaptureError


def open_recording(path: Path, options: ReadOptions) -> CaptureSource:
    """Open a recording as consecutive bursts of `options.burst` frames.

    Parameters
    ----------
    path : Path
        `.bag` or `.db3`.
    options : ReadOptions
        Burst length, and intrinsics that replace those of the recording if they pass the check.
        The depth unit is that of the recording.

    Returns
    -------
    CaptureSource
        Source of unknown length. Each iteration plays the file once and releases it at its end.
        The last burst may be shorter.

    Raises
    ------
    MissingExtraError
        If pyrealsense2 is not installed.
    CaptureError
        If the file is not a recording with colour and depth.
    """
    camera_file = read_camera_file(options.intrinsics) if options.intrinsics else None
    stated = options.with_camera(camera_file)
    if stated.depth_along is DepthAlong.RAY or stated.aligned_to is Stream.DEPTH:
        fault = "a recording's depth is along the axis and is aligned to colour here"
        remedy = "leave out --depth-along and --aligned-to"
        raise CaptureError(fault, source=path, remedy=remedy)
    realsense.import_realsense()
    with realsense.RealSenseCamera(realsense.CameraConfig(playback=path, warm_up=0)) as stream:
        frame_intrinsics, device = stream.intrinsics, stream.device
    intrinsics = choose_intrinsics(
        frame_intrinsics, camera_file, frame_intrinsics.width, frame_intrinsics.height, source=path
    )
    capture_fields = {"source": str(path), "provenance": {"reader": "recording", **device}}
    return CaptureSource(
        path, "recording", lambda: _refs(path, options.burst, intrinsics, capture_fields)
    )


def _refs(
    path: Path, burst: int, intrinsics: Intrinsics, capture_fields: dict[str, Any]
) -> Iterator[CaptureRef]:
    name = safe_name(path.stem)
    fault: CaptureError | None = None
    any_frame = False
    with realsense.RealSenseCamera(realsense.CameraConfig(playback=path, warm_up=0)) as stream:
        while fault is None:
            frames: list[realsense.AlignedFrame] = []
            try:
                stream.read_burst(frames, burst)
            except CaptureError as error:
                # Without the traceback, which would keep the pipeline alive.
                fault = error.with_traceback(None)
            if not frames:
                break
            any_frame, number = True, frames[0].number
            capture_name, place = f"{name}_{number:06d}", f"{path} frame {number}"
            load = partial(
                realsense.burst_capture,
                frames,
                intrinsics,
                capture_name,
                place=place,
                **capture_fields,
            )
            yield CaptureRef(capture_name, number, load, place)
    if fault is None and not any_frame:
        words, remedy = "has no frame with both colour and depth", "record both streams at one rate"
        fault = CaptureError(words, source=path, remedy=remedy)
    if fault is not None:
        # Captures before a fault are complete; the fault is reported as a failing capture.
        yield CaptureRef(f"{name}_end", -1, partial(fail, fault))
