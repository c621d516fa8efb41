"""One capture's work, wherever it is done: read, measure, draw, and what to write of it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.files import each_file_read_once, json_value, read_bytes
from cucumbervision.errors import CucumberVisionError
from cucumbervision.pipeline.journal import JournalRecord, place_of
from cucumbervision.pipeline.measurer import (
    Boundary,
    CaptureResult,
    DetectedCapture,
    Failure,
    Measurer,
)
from cucumbervision.pipeline.tables import capture_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from cucumbervision.capture.frames import Capture
    from cucumbervision.perception.registry import Registry
    from cucumbervision.pipeline.inputs import Listed
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.output import OutputFolder


@dataclass(frozen=True)
class Task:
    """A capture to measure, unless it was measured before.

    Parameters
    ----------
    listed : Listed
        The capture.
    known : str
        Hash of the content that was measured before in the same way; empty where none was.
    trusted : bool
        Whether it is assumed unchanged without being read, as when a run is ending.
    """

    listed: Listed
    known: str = ""
    trusted: bool = False

    @property
    def place(self) -> str:
        """The key of the capture's place in the journal."""
        return place_of(self.listed.ref.at or self.listed.input, self.listed.name)

    def dropped(self) -> Outcome | None:
        """Return its outcome when a run ends before its turn: none, or what was known."""
        one = self.listed
        return Outcome(one.input, one.name, self.place, before=True) if self.known else None

    def portable(self) -> Task | Outcome:
        """Return the task as another process can do it.

        What comes from no file of its own is read here: a recording is played in one process.
        """
        one = self.listed
        if one.ref.parts is not None or self.trusted:
            return self
        failures: list[Failure] = []
        with Boundary(failures, one.input, one.name):
            load = partial(_itself, one.ref.load())
            return replace(self, listed=replace(one, ref=replace(one.ref, load=load)))
        return Outcome(one.input, one.name, self.place, failures=tuple(failures))


@dataclass(frozen=True)
class Outcome:
    """The outcome of one capture, or of an input that could not be listed.

    Parameters
    ----------
    input, name : str
        What the user named, and the capture in it; its name is empty where the input failed.
    place : str
        Its key in the journal; empty likewise.
    record : JournalRecord, optional
        What was measured; None where nothing was.
    before : bool
        Whether it was measured by an earlier run, and its record is there.
    failures : tuple of Failure
        What went wrong.
    """

    input: str
    name: str = ""
    place: str = ""
    record: JournalRecord | None = None
    before: bool = False
    failures: tuple[Failure, ...] = ()


@dataclass(frozen=True, eq=False)
class Batch:
    """Many captures to measure into one place.

    Parameters
    ----------
    tasks : iterable of Task or Outcome
        The captures in order; an outcome among them is passed on in its turn.
    options : MeasureOptions
        How to measure.
    out : OutputFolder
        Gets the pictures.
    stop : callable
        Once it returns True, running captures are finished and no more are started.
    """

    tasks: Iterable[Task | Outcome]
    options: MeasureOptions
    out: OutputFolder
    stop: Callable[[], bool]


@dataclass(frozen=True, eq=False)
class ReadCapture:
    """A capture in memory, on its way to be looked at.

    Parameters
    ----------
    done : Outcome
        What is known of it so far.
    capture : Capture
        Under its name in the tables.
    content : str
        Hash of what it was read from.
    """

    done: Outcome
    capture: Capture
    content: str


@dataclass(frozen=True, eq=False)
class SearchedCapture:
    """A capture whose fruit were found, on its way to be measured.

    Parameters
    ----------
    read : ReadCapture
        What was read.
    detected : DetectedCapture or CaptureResult
        Its fruit, or what went wrong.
    """

    read: ReadCapture
    detected: DetectedCapture | CaptureResult


class Worker:
    """Does tasks; networks are loaded once, with the first capture that is not done yet.

    Parameters
    ----------
    options : MeasureOptions
        How to measure.
    out : OutputFolder
        Gets the pictures.
    registry : Registry, optional
        Where networks with a name lie; the package's own if not given.
    """

    def __init__(
        self, options: MeasureOptions, out: OutputFolder, registry: Registry | None = None
    ) -> None:
        self._measurer = Measurer(options, registry)
        self._out = out

    def load(self) -> None:
        """Load what is needed.

        Raises
        ------
        CucumberVisionError
            If a network, the file of instances or the calibration cannot be loaded.
        """
        self._measurer.load()

    def __call__(self, task: Task) -> Outcome:
        """Do a task: `read` it, `look` at it, and `measure` it."""
        return self.measure(self.detect(self.read(task)))

    def read(self, task: Task) -> Outcome | ReadCapture:
        """Read a capture, unless it was measured before; what goes wrong is in the outcome."""
        one = task.listed
        done = Outcome(one.input, one.name, task.place)
        if task.trusted:
            return replace(done, before=True)
        failures: list[Failure] = []
        content, capture = "", None
        with each_file_read_once():
            if one.ref.parts is not None:
                content = content_of(one.ref.parts())
            if content and content == task.known and self._out.has(_picture(one.name)):
                return replace(done, before=True)
            with Boundary(failures, one.input, one.name):
                capture = replace(one.ref.load(), name=one.name)
        if capture is None:
            return replace(done, failures=tuple(failures))
        content = content or _content_of_capture(capture)
        if content == task.known and self._out.has(_picture(one.name)):
            return replace(done, before=True)
        return ReadCapture(done, capture, content)

    def detect(self, read: Outcome | ReadCapture) -> Outcome | SearchedCapture:
        """Find the fruit of what was read; whatever goes wrong in the capture stays in it.

        Raises
        ------
        CucumberVisionError
            If nothing can be measured at all, as `load`.
        """
        if isinstance(read, Outcome):
            return read
        self.load()
        return SearchedCapture(read, self._measurer.attempt_detect(read.capture))

    def measure(self, seen: Outcome | SearchedCapture) -> Outcome:
        """Measure the fruit that were found, draw them, and say what to journal."""
        if isinstance(seen, Outcome):
            return seen
        done, capture, content = seen.read.done, seen.read.capture, seen.read.content
        result = self._measurer.attempt_measure(seen.detected)
        failures = list(result.failures)
        record = picture = None
        if result.error is None:
            with Boundary(failures, capture.source, capture.name):
                rows = result.rows()
                said = capture_json(result, rows)
                digest = self._measurer.hashes.of(result.stages)
                models = self._measurer.models_of(result.stages)
                stages = tuple(map(str, result.stages))
                record = JournalRecord(done.place, content, stages, digest, said, (), models, None)
        if record is not None:
            with Boundary(failures, capture.source, capture.name):
                self._draw(result)
                picture = _picture(capture.name)
            record = replace(record, failures=tuple(failures), picture=picture)
        return replace(done, record=record, failures=tuple(failures))

    def _draw(self, result: CaptureResult) -> None:
        import cv2

        from cucumbervision.pipeline.overlay import draw_overlay

        _, data = cv2.imencode(".png", draw_overlay(result.capture, result.fruit)[..., ::-1])
        self._out.write(_picture(result.capture.name), data.tobytes())


def _itself(capture: Capture) -> Capture:
    return capture


def _picture(name: str) -> str:
    return f"overlays/{name}.png"


def content_of(parts: Iterable[Path | bytes]) -> str:
    """Hash what a capture is read from; empty where a part of it cannot be read.

    Examples
    --------
    >>> content_of([b"camera"]) == content_of([b"camera"]) != content_of([b"other"])
    True
    """
    digest = hashlib.sha256()
    try:
        for part in parts:
            name, data = ("", part) if isinstance(part, bytes) else (part.name, read_bytes(part))
            digest.update(f"{len(data)} {name}\n".encode(errors="surrogatepass"))
            digest.update(data)
    except (CucumberVisionError, OSError):  # loading it raises the error
        return ""
    return digest.hexdigest()


def _content_of_capture(capture: Capture) -> str:
    """Hash a capture that comes from no file of its own."""
    about = [capture.frame, capture.burst_frame, capture.burst_size, capture.timestamp_s]
    camera = [vars(capture.intrinsics), vars(capture.stop), capture.source]
    digest = hashlib.sha256(json.dumps(json_value([about, camera])).encode())
    for array in (capture.color, capture.depth_m, *capture.masks):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
