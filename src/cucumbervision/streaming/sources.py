"""Where a stream's frames come from: a camera, a recording in its place, a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.camera import FolderCamera, captures_of
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import RECORDING_SUFFIXES, ReadOptions
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.pipeline.inputs import read_captures
from cucumbervision.pipeline.measurer import Failure
from cucumbervision.streaming.newest import Arrival, in_order, newest_first, paced

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from cucumbervision.capture.camera import RgbdCamera

_CAMERA = "camera"


def open_stream(
    source: str | Path,
    reading: ReadOptions | None = None,
    *,
    config: CameraConfig | None = None,
    every: bool = False,
    follow: bool = False,
    retries: int = 0,
) -> Iterator[Arrival[Capture | Failure]]:
    """Open what frames come from.

    A camera does not wait: who is slow gets its newest frame, and those before are dropped and
    counted. A recording is played in a camera's place, at its own pace. The captures of a folder
    wait, so that each is given in turn; a folder that is followed is a camera again.

    Parameters
    ----------
    source : str or Path
        'camera', or a recording or folder as `open_source` takes it.
    reading : ReadOptions, optional
        What is said of recording or folder.
    config : CameraConfig, optional
        Of the camera: serial number, size, rate.
    every : bool
        Give every frame of a recording or of a followed folder, however late.
    follow : bool
        Wait for what comes into a folder; what is there already is passed over.
    retries : int
        How often a camera that is gone is opened again.

    Raises
    ------
    CucumberVisionError
        When the first frame is asked for: if the source cannot be opened. A camera that is gone
        raises after its last frame.

    Examples
    --------
    >>> from cucumbervision.capture.source import example_captures
    >>> [one.item.name for one in open_stream(example_captures())]
    ['simulated-bench', 'simulated-row-a', 'simulated-row-b']
    """
    if str(source) == _CAMERA:
        single = replace(config or CameraConfig(), burst=1)
        return stream_camera(lambda: RealSenseCamera(single), retries)
    path, reading = Path(source), replace(reading or ReadOptions(), burst=1)
    if follow:
        return stream_camera(lambda: FolderCamera(path, reading), retries, every=every)
    if path.suffix.lower() not in RECORDING_SUFFIXES:
        return in_order(read_captures([path], reading))
    frames = read_captures([path], reading)
    return in_order(frames) if every else newest_first(paced(frames))


def stream_camera(
    open_camera: Callable[[], RgbdCamera], retries: int = 0, *, every: bool = False
) -> Iterator[Arrival[Capture | Failure]]:
    """Open any camera as `open_stream` opens a RealSense.

    Parameters
    ----------
    open_camera : callable
        Makes the camera.
    retries : int
        How often one that is gone is opened again.
    every : bool
        Drop nothing.
    """
    items: Iterator[Capture | Failure] = (
        one if isinstance(one, Capture) else Failure.of(one, one.source)
        for one in captures_of(open_camera, retries)
    )
    return in_order(items) if every else newest_first(items)
