"""The sources of a stream: a camera, a recording played as a camera, a folder.

A camera does not wait: a thread takes every frame, and a slow consumer gets the newest one.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from cucumbervision.capture.camera import FolderCamera, captures_of
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import RECORDING_SUFFIXES, ReadOptions
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.pipeline.inputs import read_captures
from cucumbervision.pipeline.measurer import Failure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from cucumbervision.capture.camera import RgbdCamera

_CAMERA = "camera"
_LONGEST_WAIT_S = 2.0  # between two frames: a recording may have been paused

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Arrival(Generic[T]):
    """Something that came, and when.

    Parameters
    ----------
    item : object
        What came.
    received_s : float
        When, by `time.monotonic`.
    dropped : int
        How many older ones were dropped since the one that was taken before it.
    """

    item: T
    received_s: float
    dropped: int = 0


def in_order(items: Iterable[T]) -> Iterator[Arrival[T]]:
    """Yield everything, one after the other: for what waits.

    Examples
    --------
    >>> [(one.item, one.dropped) for one in in_order("ab")]
    [('a', 0), ('b', 0)]
    """
    for item in items:
        yield Arrival(item, time.monotonic())


def newest_first(items: Iterable[T]) -> Iterator[Arrival[T]]:
    """Yield the newest of what comes; what came before it unseen is dropped and counted.

    A thread takes every item as it comes. It ends with the items, or with the next item after the
    iterator was closed. What the items raise is raised here, after the last that came.

    Parameters
    ----------
    items : iterable
        What comes by itself: a camera's frames.

    Examples
    --------
    >>> import threading
    >>> seen = threading.Event()
    >>> def frames():
    ...     yield 1
    ...     seen.wait()
    ...     yield from (2, 3, 4)
    >>> stream = newest_first(frames())
    >>> next(stream).item
    1
    >>> seen.set()
    >>> rest = [(one.item, one.dropped) for one in stream]
    >>> rest[-1][0], sum(dropped for _, dropped in rest) + len(rest)
    (4, 3)
    """
    inbox = _Inbox[T]()
    threading.Thread(target=inbox.fill, args=(items,), name="frames", daemon=True).start()
    try:
        while (arrival := inbox.take()) is not None:
            yield arrival
    finally:
        inbox.close()


class _Inbox(Generic[T]):
    """Room for the newest item."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: Arrival[T] | None = None
        self._error: BaseException | None = None
        self._ended = self._closed = False

    def fill(self, items: Iterable[T]) -> None:
        try:
            for item in items:
                if self._put(Arrival(item, time.monotonic())):
                    break
        except BaseException as error:
            # Whatever it is belongs to who takes the items: this thread has nobody to tell.
            self._error = error
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()  # lets a camera go in the thread that used it
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _put(self, arrival: Arrival[T]) -> bool:
        with self._changed:
            before = self._newest
            missed = 0 if before is None else before.dropped + 1
            self._newest = replace(arrival, dropped=missed)
            self._changed.notify_all()
            return self._closed

    def take(self) -> Arrival[T] | None:
        with self._changed:
            while self._newest is None and not self._ended:
                self._changed.wait()
            arrival, self._newest = self._newest, None
            if arrival is None and self._error is not None:
                raise self._error
            return arrival

    def close(self) -> None:
        with self._changed:
            self._closed = True


def paced(
    captures: Iterable[T],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[T]:
    """Yield captures no sooner after the first than they were taken: a recording as a camera.

    Parameters
    ----------
    captures : iterable
        What is no `Capture`, or has no time, is not waited for.
    clock, sleep : callable
        Seconds that run on, and how to wait for some.

    Examples
    --------
    >>> list(paced(["no capture"]))
    ['no capture']
    """
    begun: tuple[float, float] | None = None
    for capture in captures:
        taken_s = capture.timestamp_s if isinstance(capture, Capture) else None
        if taken_s is not None:
            begun = begun or (clock(), taken_s)
            wait_s = (taken_s - begun[1]) - (clock() - begun[0])
            # A clock that was set back has no pace to follow.
            if wait_s > 0:
                sleep(min(wait_s, _LONGEST_WAIT_S))
        yield capture


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
