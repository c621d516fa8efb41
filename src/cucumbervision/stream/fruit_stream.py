"""Sources of frames (camera, recording, folder), and the fruit of each frame, tracked and measured.

A camera does not wait: a thread takes every frame, and a slow consumer gets the newest one.
`FruitStream` measures one frame at a time with `Measurer`. Its fast form uses the detector's masks,
without SAM and without the network that looks at each fruit, and measures only the fruit of a frame
whose lengths gain most: frames from one place add little information on a fruit (`tracks.FIXED`).
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Generic, Literal, TypeVar

from pydantic import BaseModel

from cucumbervision.capture.camera import FolderCamera, RgbdCamera, captures_of
from cucumbervision.capture.frames import Capture, moved_px
from cucumbervision.capture.readers import RECORDING_SUFFIXES, ReadOptions
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.methods.flags import is_length_unknown, is_lower_bound
from cucumbervision.methods.result import Choice, Fruit, FruitPose, Length, MethodName
from cucumbervision.networks.runtime import CARD_RUNTIMES
from cucumbervision.run.batch import cores, read_captures
from cucumbervision.run.fields import FIELDS, Cell, Field, fruit_row, row_model
from cucumbervision.run.finders import Detections
from cucumbervision.run.measurer import CaptureResult, Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.stream.tracks import Track, Tracker, same_place, sighting_of

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


_FAST_SIZE_PX = 640
_LONGEST_GAP_S = 1.0
_FEWEST_CORES = 4  # for searching and measuring at once
_AGAIN_AFTER = 10  # frames before a fruit is measured again from the same place


@dataclass(frozen=True, eq=False)
class TrackedFruit:
    """One fruit of one frame, with the results of all its frames.

    Parameters
    ----------
    capture : Capture
        The frame.
    number : int
        The fruit's number in it, from 1.
    fruit : Fruit
        The fruit; one that was not selected has no measurement in this frame.
    track : int
        Number of the fruit, the same in all frames.
    seen_frames : int
        Frames in which it was seen, including this one.
    length : Length, optional
        Its length from all frames; None until the whole fruit was measured.
    at_least_m : float, optional
        The longest lower bound, while `length` is None.
    frames, places : int
        Number of frames and places that contribute to `length`.
    """

    capture: Capture
    number: int
    fruit: Fruit
    track: int
    seen_frames: int
    length: Length | None = None
    at_least_m: float | None = None
    frames: int = 0
    places: int = 0


TRACK_FIELDS = (
    Field("track", "", "whole", "number of the fruit, the same in all frames", "track"),
    Field("seen", "", "whole", "frames in which it was seen, this one included", "seen_frames"),
    Field("track_length_cm", "cm", "number", "length from all frames", "length.value_m"),
    Field("track_low_cm", "cm", "number", "lower end of its 90 % interval", "length.low_m"),
    Field("track_high_cm", "cm", "number", "upper end of its 90 % interval", "length.high_m"),
    Field("track_at_least_cm", "cm", "number", "lower bound, where no more is known", "at_least_m"),
    Field("track_frames", "", "whole", "frames in that length", "frames"),
    Field("track_places", "", "whole", "places from which they were taken", "places"),
)
"""Fields of a fruit in a stream, beside the table of fields."""

_OF_FRUIT = tuple(column for column in FIELDS if column.owner == "fruit")
_OF_CAPTURE = tuple(column for column in FIELDS if column not in _OF_FRUIT)


@dataclass(frozen=True, eq=False)
class StreamedFrame:
    """The result of one frame of a stream.

    Parameters
    ----------
    result : CaptureResult
        The frame, the fruit measured in it, and failures.
    fruit : tuple of TrackedFruit
        The same fruit with track numbers and combined lengths.
    latency_s : float
        Time from the frame's arrival to its result.
    dropped : int
        Older frames dropped before it.
    """

    result: CaptureResult
    fruit: tuple[TrackedFruit, ...]
    latency_s: float
    dropped: int = 0

    @property
    def capture(self) -> Capture:
        """The measured frame."""
        return self.result.capture

    def __repr__(self) -> str:
        return f"<StreamedFrame {self.capture.name}: {list(self.result.fruit)}>"

    def as_json(self) -> dict[str, Any]:
        """Return the frame as a JSON object with the fields that have a value."""
        values: dict[str, Any] = {
            "version": 1,
            **_cells((*_OF_CAPTURE, *FRAME_FIELDS), self),
            "fruit": [_fruit_json(tracked, self.result.fields) for tracked in self.fruit],
        }
        if self.result.failures:
            values["failures"] = [vars(failure) for failure in self.result.failures]
        return values


FRAME_FIELDS = (
    Field("latency_s", "s", "number", "from the frame's arrival to its line", "latency_s", 4),
    Field("dropped", "", "whole", "older frames dropped before this one", "dropped"),
)
"""Fields of a frame in a stream, beside the table of fields."""


def line_model() -> type[BaseModel]:
    """Return the pydantic model of a stream's line, version 1, for its JSON Schema.

    Fields may be added to a version; none changes its meaning or goes.

    Examples
    --------
    >>> sorted(line_model().model_json_schema()["required"])
    ['fruit', 'version']
    """
    fruit = row_model("StreamedFruit", (*TRACK_FIELDS, *_OF_FRUIT), pose=(FruitPose | None, None))
    return row_model(
        "StreamLine",
        (*_OF_CAPTURE, *FRAME_FIELDS),
        version=(Literal[1], ...),
        fruit=(list[fruit], ...),  # type: ignore[valid-type]
        failures=(list[Failure], []),
    )


def _fruit_json(tracked: TrackedFruit, fields: tuple[Field, ...]) -> dict[str, Any]:
    of_fruit = (*_OF_FRUIT, *fields[len(FIELDS) :])
    row = fruit_row(tracked.capture, tracked.number, tracked.fruit, of_fruit)
    cells = _cells(TRACK_FIELDS, tracked) | _filled(row)
    return cells if tracked.fruit.pose is None else {**cells, "pose": tracked.fruit.pose.as_json()}


def _cells(fields: tuple[Field, ...], line: Any) -> dict[str, Cell]:
    return _filled({column.name: column.of(line) for column in fields})


def _filled(cells: dict[str, Cell]) -> dict[str, Cell]:
    return {name: cell for name, cell in cells.items() if cell not in (None, "")}


class FruitStream:
    """Measures frames in order and tracks their fruit.

    Parameters
    ----------
    measurer : Measurer, optional
        The measurer; loaded with the first frame.
    fits : int, optional
        Largest number of fruit measured per frame: first those never measured, then those seen from
        a new place, then, every ten frames, the others. All if not given.

    Examples
    --------
    >>> from cucumbervision.capture.readers import open_source
    >>> from cucumbervision.capture.source import example_captures
    >>> stream = FruitStream(Measurer(MeasureOptions(instances="dataset")))
    >>> capture = next(iter(open_source(example_captures()))).load()
    >>> frames = [stream.take(capture, at_s=at) for at in (0.0, 0.1, 0.2)]
    >>> [[fruit.track for fruit in frame.fruit] for frame in frames]
    [[1, 2, 3], [1, 2, 3], [1, 2, 3]]
    >>> line = frames[-1].as_json()["fruit"][0]
    >>> line["seen"], line["track_frames"], line["track_places"], round(line["track_length_cm"])
    (3, 3, 1, 16)
    """

    def __init__(self, measurer: Measurer | None = None, *, fits: int | None = None) -> None:
        self.measurer = measurer or Measurer()
        self._fits = fits
        self._tracker = Tracker()
        self._received_s: float | None = None
        self._own_s = 0.0
        self._before: Capture | None = None

    @classmethod
    def fast(cls, options: MeasureOptions | None = None) -> FruitStream:
        """Return a fast stream: half precision, no SAM, one fruit measured per frame.

        Runtime, confidence, calibration and reading are those of the options.
        """
        options = options or MeasureOptions()
        fast = replace(
            options,
            segmenter="none",
            quick=True,
            input_sizes=options.input_sizes or (_FAST_SIZE_PX,),
            full_precision=False,
            methods=(MethodName.M3, MethodName.M5, MethodName.M6),  # fallbacks of M6
        )
        return cls(Measurer(fast), fits=1)

    def follow(
        self, arrivals: Iterable[Arrival[Capture | Failure]]
    ) -> Iterator[StreamedFrame | Failure]:
        """Yield the result of each frame.

        Where the networks run on a card, and with four cores or more, the next frame is searched
        while a frame is measured. Two cores are the networks' own: every frame would come later,
        and no more of them.

        Parameters
        ----------
        arrivals : iterable of Arrival
            As `sources.open_stream` yields them.

        Yields
        ------
        StreamedFrame or Failure
            A frame, or the failure to read or measure one; the stream continues.
        """
        # Before the first frame, so that none is dropped while networks load.
        self.measurer.warm_up()
        overlapped = cores() >= _FEWEST_CORES or self.measurer.options.runtime in CARD_RUNTIMES
        searched = ahead(arrivals, self._detected) if overlapped else map(self._detected, arrivals)
        for arrival, detected in searched:
            if isinstance(detected, Failure):
                yield detected
                continue
            capture = detected[0]
            try:
                frame = self._measured(*detected, arrival.received_s, arrival.dropped)
            except Exception as error:
                yield Failure.of(error, capture.source, capture.name)
                continue
            yield frame

    def _detected(
        self, arrival: Arrival[Capture | Failure]
    ) -> tuple[Arrival[Capture | Failure], tuple[Capture, Detections] | Failure]:
        """Search an arrival; in another thread than the one that measures the frame before it."""
        item = arrival.item
        if isinstance(item, Failure):
            return arrival, item
        try:
            return arrival, self.measurer.detect(item)
        except Exception as error:
            return arrival, Failure.of(error, item.source, item.name)

    def take(
        self,
        capture: Capture,
        *,
        at_s: float | None = None,
        received_s: float | None = None,
        dropped: int = 0,
    ) -> StreamedFrame:
        """Measure one frame.

        Parameters
        ----------
        capture : Capture
            The frame; frames must be in order.
        at_s : float, optional
            When it was taken; by default its own time, or its arrival if it has none, at most one
            second after the previous one.
        received_s : float, optional
            Time of arrival by `time.monotonic`; now by default.
        dropped : int
            Older frames dropped before it.

        Raises
        ------
        CucumberVisionError
            As `Measurer.measure`.
        """
        received_s = time.monotonic() if received_s is None else received_s
        return self._measured(*self.measurer.detect(capture), received_s, dropped, at_s)

    def _measured(
        self,
        capture: Capture,
        detections: Detections,
        received_s: float,
        dropped: int,
        at_s: float | None = None,
    ) -> StreamedFrame:
        """Track and measure the fruit of a frame; frames come in order."""
        if at_s is None:
            at_s = capture.timestamp_s
        if at_s is None:
            at_s = self._own_time(received_s)
        if self._is_elsewhere(capture):
            self._tracker.forget()
        sightings = [sighting_of(capture, instance) for instance in detections.instances]
        tracks = self._tracker.assign(sightings, capture.intrinsics, at_s)
        result = self.measurer.measure_detected(capture, detections, self._choose(tracks))
        fruit = tuple(
            self._tracked(result.capture, number, measured, track)
            for number, (measured, track) in enumerate(zip(result.fruit, tracks, strict=True), 1)
        )
        return StreamedFrame(result, fruit, time.monotonic() - received_s, dropped)

    def _is_elsewhere(self, capture: Capture) -> bool:
        """Return whether a frame shows another scene than the previous one."""
        before, self._before = self._before, capture
        if before is None:
            return False
        if (before.stop, before.intrinsics) != (capture.stop, capture.intrinsics):
            return True
        if before.timestamp_s is not None and capture.timestamp_s is not None:
            return False
        # Without times, only the images show how far the camera moved.
        return math.isinf(moved_px(before.color, [capture.color])[0])

    def _own_time(self, received_s: float) -> float:
        """Return the time of a frame without one, from the arrivals.

        A gap of more than a second is a delay of this program, not movement.
        """
        before_s = received_s if self._received_s is None else self._received_s
        self._received_s = received_s
        self._own_s += min(max(received_s - before_s, 0.0), _LONGEST_GAP_S)
        return self._own_s

    def _choose(self, tracks: list[Track]) -> frozenset[int]:
        """Return the detections to measure now."""
        if self._fits is None:
            return frozenset(range(len(tracks)))

        def gain(track: Track) -> tuple[bool, bool, int]:
            before = track.measured_at
            new = before is None or not same_place(before.at_m, track.sighting.at_m)
            return before is None, new, track.waiting

        gains = {k: gain(track) for k, track in enumerate(tracks)}
        due = [k for k, (_, new, waiting) in gains.items() if new or waiting >= _AGAIN_AFTER]
        return frozenset(sorted(due, key=gains.__getitem__, reverse=True)[: self._fits])

    def _tracked(self, capture: Capture, number: int, fruit: Fruit, track: Track) -> TrackedFruit:
        length = None if is_length_unknown(fruit.flags) else fruit.length
        partial = is_lower_bound(fruit.flags)
        if length is not None and track.length.contradicts(length, partial=partial):
            track = self._tracker.split(track)
        track.seen_frames += 1
        track.waiting += 1
        if fruit.reason is not Choice.WAITING:
            track.measured_at, track.waiting = track.sighting, 0
        if length is not None:
            at_m, scale_known = track.sighting.at_m, self.measurer.scale_known
            track.length.add(length, at_m, partial=partial, scale_known=scale_known)
        of_all = track.length
        at_least_m = of_all.at_least_m if of_all.length is None else None
        return TrackedFruit(
            capture,
            number,
            fruit,
            track=track.number,
            seen_frames=track.seen_frames,
            length=of_all.length,
            at_least_m=at_least_m,
            frames=of_all.frames,
            places=len(of_all.places),
        )
