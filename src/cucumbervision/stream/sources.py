"""The sources of a stream: a camera, a recording played as a camera, a folder; reading ahead.

A camera does not wait: a thread takes every frame, and a slow consumer gets the newest one.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Generic, TypeVar

from cucumbervision.capture.camera import FolderCamera, captures_of
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import RECORDING_SUFFIXES, ReadOptions
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.run.inputs import read_captures
from cucumbervision.run.measurer import Failure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from cucumbervision.capture.camera import RgbdCamera

_CAMERA = "camera"
_LONGEST_WAIT_S = 2.0  # between two frames: a recording may have been paused

T = TypeVar("T")
U = TypeVar("U")


@dataclass(frozen=True, eq=False)
class Arrival(Generic[T]):
    """An item of a stream and its time of arrival.

    Parameters
    ----------
    item : object
        The item.
    received_s : float
        Time of arrival by `time.monotonic`.
    dropped : int
        Number of older items dropped since the previous one.
    """

    item: T
    received_s: float
    dropped: int = 0


def in_order(items: Iterable[T]) -> Iterator[Arrival[T]]:
    """Yield every item in order; for sources that wait.

    Examples
    --------
    >>> [(arrival.item, arrival.dropped) for arrival in in_order("ab")]
    [('a', 0), ('b', 0)]
    """
    for item in items:
        yield Arrival(item, time.monotonic())


def newest_first(items: Iterable[T]) -> Iterator[Arrival[T]]:
    """Yield the newest item; older ones that were not taken are dropped and counted.

    A thread takes every item on arrival. It ends with the items, or with the first item after the
    iterator is closed. An exception of the source is raised here, after its last item.

    Parameters
    ----------
    items : iterable
        A source that does not wait, such as a camera's frames.

    Examples
    --------
    >>> import threading
    >>> taken = threading.Event()
    >>> def frames():
    ...     yield 1
    ...     taken.wait()
    ...     yield from (2, 3, 4)
    >>> stream = newest_first(frames())
    >>> next(stream).item
    1
    >>> taken.set()
    >>> pairs = [(arrival.item, arrival.dropped) for arrival in stream]
    >>> pairs[-1][0], sum(dropped for _, dropped in pairs) + len(pairs)
    (4, 3)
    """
    inbox: deque[tuple[int, Arrival[T]]] = deque(maxlen=1)
    ended: list[BaseException | None] = []
    numbers, changed, left = count(), threading.Event(), threading.Event()

    def take(item: T) -> bool:
        inbox.append((next(numbers), Arrival(item, time.monotonic())))
        changed.set()
        return not left.is_set()

    def end(error: BaseException | None) -> None:
        ended.append(error)
        changed.set()

    _in_thread("frames", items, take, end)
    before, is_last = -1, False
    try:
        while not is_last and changed.wait():
            changed.clear()
            is_last = bool(ended)
            if inbox:
                number, arrival = inbox.pop()
                yield replace(arrival, dropped=number - before - 1)
                before = number
    finally:
        left.set()
    if ended[0] is not None:
        raise ended[0]


def ahead(items: Iterable[T], work: Callable[[T], U]) -> Iterator[U]:
    """Yield a function's results in order, computed in a thread while the last one is used.

    One result at most waits: the next item is requested when it is taken, so that a camera's frame
    is not old before it is looked at.

    Parameters
    ----------
    items : iterable
        What the function gets. An exception of it is raised here, after the last result.
    work : callable
        The function. If the iterator is closed, it ends what it has begun.

    Examples
    --------
    >>> list(ahead("abc", str.upper))
    ['A', 'B', 'C']
    """
    results: SimpleQueue[tuple[U] | BaseException | None] = SimpleQueue()
    working, taken, left = threading.Lock(), threading.Semaphore(0), threading.Event()

    def take(item: T) -> bool:
        with working:
            if left.is_set():
                return False
            results.put((work(item),))
        taken.acquire()
        return not left.is_set()

    _in_thread("ahead", items, take, results.put)
    try:
        while isinstance(result := results.get(), tuple):
            taken.release()
            yield result[0]
    finally:
        left.set()
        taken.release()
        with working:  # a runtime that is computing must not meet the end of the process
            pass
    if result is not None:
        raise result


def _in_thread(
    name: str,
    items: Iterable[T],
    take: Callable[[T], bool],
    end: Callable[[BaseException | None], None],
) -> None:
    """Take items in a thread until `take` returns False; `end` gets an error of theirs."""

    def fill() -> None:
        raised: BaseException | None = None
        try:
            for item in items:
                if not take(item):
                    break
        except BaseException as error:
            raised = error
        finally:
            if close := getattr(items, "close", None):
                close()  # releases a camera in the thread that used it
            end(raised)

    threading.Thread(target=fill, name=name, daemon=True).start()


def paced(
    captures: Iterable[T],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[T]:
    """Yield captures at the pace at which they were taken, like a camera.

    Parameters
    ----------
    captures : iterable
        Captures; other items, and captures without a time, are yielded at once.
    clock, sleep : callable
        Clock in seconds, and the function that waits.

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
            # The recording's clock may have been set back.
            if wait_s > 0:
                sleep(min(wait_s, _LONGEST_WAIT_S))
        yield capture


def open_stream(
    source: str | Path,
    reading: ReadOptions | None = None,
    *,
    config: CameraConfig | None = None,
    every_frame: bool = False,
    follow: bool = False,
    retries: int = 0,
) -> Iterator[Arrival[Capture | Failure]]:
    """Open a source of frames.

    A camera does not wait: a slow consumer gets its newest frame, and older ones are dropped and
    counted. A recording is played like a camera, at its own pace. The captures of a folder are
    given in order; a followed folder behaves like a camera.

    Parameters
    ----------
    source : str or Path
        'camera', or a recording or folder as `open_source` takes it.
    reading : ReadOptions, optional
        How to read a recording or folder.
    config : CameraConfig, optional
        The camera's serial number, size and rate.
    every_frame : bool
        Yield every frame of a recording or followed folder; drop none.
    follow : bool
        Wait for new files in a folder; existing ones are skipped.
    retries : int
        Maximum number of attempts to reopen a disconnected camera.

    Raises
    ------
    CucumberVisionError
        On the first frame, if the source cannot be opened; after the last one, if a camera is
        disconnected.

    Examples
    --------
    >>> from cucumbervision.capture.source import example_captures
    >>> [arrival.item.name for arrival in open_stream(example_captures())]
    ['simulated-bench', 'simulated-row-a', 'simulated-row-b']
    """
    if str(source) == _CAMERA:
        single = replace(config or CameraConfig(), burst=1)
        return stream_camera(lambda: RealSenseCamera(single), retries)
    path, reading = Path(source), replace(reading or ReadOptions(), burst=1)
    if follow:
        return stream_camera(lambda: FolderCamera(path, reading), retries, every_frame=every_frame)
    frames = read_captures([path], reading)
    if path.suffix.lower() in RECORDING_SUFFIXES and not every_frame:
        return newest_first(paced(frames))
    return in_order(ahead(frames, lambda frame: frame))


def stream_camera(
    open_camera: Callable[[], RgbdCamera], retries: int = 0, *, every_frame: bool = False
) -> Iterator[Arrival[Capture | Failure]]:
    """Open any camera as `open_stream` does a RealSense.

    Parameters
    ----------
    open_camera : callable
        Opens the camera.
    retries : int
        Maximum number of attempts to reopen a disconnected camera.
    every_frame : bool
        Yield every frame; drop none.
    """
    items: Iterator[Capture | Failure] = (
        outcome if isinstance(outcome, Capture) else Failure.of(outcome, outcome.source)
        for outcome in captures_of(open_camera, retries)
    )
    return in_order(items) if every_frame else newest_first(items)
