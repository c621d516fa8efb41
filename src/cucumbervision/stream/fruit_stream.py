"""Measure the fruit of a stream: detect, track, and combine lengths over frames.

`FruitStream` measures one frame at a time with `Measurer`. Its fast form uses the detector's masks,
without SAM and without the network that looks at each fruit, and measures only the fruit of a frame
whose lengths gain most: frames from one place add little information on a fruit (`tracks.FIXED`).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from cucumbervision.capture.frames import moved_px
from cucumbervision.methods.flags import is_length_unknown, is_lower_bound
from cucumbervision.methods.result import Choice, FruitPose, MethodName
from cucumbervision.networks.runtime import CARD_RUNTIMES
from cucumbervision.run.batch import cores
from cucumbervision.run.fields import FIELDS, Field, fruit_row, row_model
from cucumbervision.run.measurer import Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.stream.sources import ahead
from cucumbervision.stream.tracks import Sighting, Tracker, TrackLength, same_place, sighting_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from pydantic import BaseModel

    from cucumbervision.capture.frames import Capture
    from cucumbervision.methods.result import Fruit, Length
    from cucumbervision.run.fields import Cell
    from cucumbervision.run.finders import Detections
    from cucumbervision.run.measurer import CaptureResult
    from cucumbervision.stream.sources import Arrival

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


@dataclass
class _TrackState:
    """State of a tracked fruit."""

    length: TrackLength = field(default_factory=TrackLength)
    seen_frames: int = 0
    measured_at: Sighting | None = None
    waiting: int = 0


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
        self._states: dict[int, _TrackState] = {}
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
        numbers = self._tracker.assign(sightings, capture.intrinsics, at_s)
        self._states = {n: self._states.get(n, _TrackState()) for n in self._tracker.numbers}
        chosen = self._choose(numbers, sightings)
        result = self.measurer.measure_detected(capture, detections, chosen)
        fruit = tuple(
            self._tracked(result.capture, k, measured, numbers[k], sightings[k])
            for k, measured in enumerate(result.fruit)
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
        # Without times, only the pictures show how far the camera moved.
        return math.isinf(moved_px(before.color, [capture.color])[0])

    def _own_time(self, received_s: float) -> float:
        """Return the time of a frame without one, from the arrivals.

        A gap of more than a second is a delay of this program, not movement.
        """
        before_s = received_s if self._received_s is None else self._received_s
        self._received_s = received_s
        self._own_s += min(max(received_s - before_s, 0.0), _LONGEST_GAP_S)
        return self._own_s

    def _choose(self, numbers: list[int], sightings: list[Sighting]) -> frozenset[int]:
        """Return the detections to measure now."""
        if self._fits is None:
            return frozenset(range(len(numbers)))

        def gain(k: int) -> tuple[bool, bool, int]:
            state = self._states[numbers[k]]
            before = state.measured_at
            new = before is None or not same_place(before.at_m, sightings[k].at_m)
            return before is None, new, state.waiting

        gains = {k: gain(k) for k in range(len(numbers))}
        due = [k for k, (_, new, waiting) in gains.items() if new or waiting >= _AGAIN_AFTER]
        return frozenset(sorted(due, key=gains.__getitem__, reverse=True)[: self._fits])

    def _tracked(
        self, capture: Capture, k: int, fruit: Fruit, number: int, sighting: Sighting
    ) -> TrackedFruit:
        state = self._states[number]
        length = None if is_length_unknown(fruit.flags) else fruit.length
        partial = is_lower_bound(fruit.flags)
        if length is not None and state.length.contradicts(length, partial=partial):
            number = self._tracker.split(number)
            state = self._states[number] = _TrackState()
        state.seen_frames += 1
        state.waiting += 1
        if fruit.reason is not Choice.WAITING:
            state.measured_at, state.waiting = sighting, 0
        if length is not None:
            site = self.measurer.site
            scale_known = site is not None and site.depth_scale is not None
            state.length.add(length, sighting.at_m, partial=partial, scale_known=scale_known)
        of_all = state.length
        at_least_m = of_all.at_least_m if of_all.length is None else None
        return TrackedFruit(
            capture,
            k + 1,
            fruit,
            track=number,
            seen_frames=state.seen_frames,
            length=of_all.length,
            at_least_m=at_least_m,
            frames=of_all.frames,
            places=len(of_all.places),
        )
