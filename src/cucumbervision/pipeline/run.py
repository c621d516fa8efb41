"""Measure many captures into a folder, with a journal of finished captures and final tables."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from cucumbervision.errors import CucumberVisionError
from cucumbervision.files import each_file_read_once, json_value, read_bytes
from cucumbervision.pipeline.batch import (
    Item,
    LoopOptions,
    Outcome,
    ReadCapture,
    Worker,
    measure_all,
)
from cucumbervision.pipeline.finders import instance_notes
from cucumbervision.pipeline.folder import Journal, JournalRecord, OutputFolder, place_of
from cucumbervision.pipeline.inputs import Listed, distinct, each_once, list_captures
from cucumbervision.pipeline.measurer import (
    Boundary,
    CaptureResult,
    Failure,
    Measurer,
    exit_code,
    plugin_failures,
)
from cucumbervision.pipeline.summary import Summary
from cucumbervision.pipeline.tables import (
    capture_json,
    import_arrow,
    provenance_of,
    rows_of,
    write_reports,
)
from cucumbervision.urls import as_path

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from cucumbervision.capture.frames import Capture
    from cucumbervision.pipeline.fields import Cell
    from cucumbervision.pipeline.options import MeasureOptions


@dataclass(frozen=True, eq=False)
class Step:
    """A finished capture of a run, or an input that could not be listed.

    Parameters
    ----------
    name : str
        Name of the capture in the tables; empty if the input failed.
    record : JournalRecord, optional
        The result; None if nothing was measured.
    before : bool
        Whether an earlier run measured it.
    failures : tuple of Failure
        The failures.
    """

    name: str
    record: JournalRecord | None = field(repr=False)
    before: bool
    failures: tuple[Failure, ...]


Report: TypeAlias = Callable[[Step], None]
Overlays: TypeAlias = Literal["png", "jpg", "none"]
"""Kind of the annotated pictures."""


@dataclass(frozen=True)
class BatchOptions(LoopOptions):
    """Options of a run that do not change rows.

    Parameters
    ----------
    opener, engine, is_cancelled
        As in `LoopOptions`.
    parquet : bool
        Also write `parquet/`, in parts of 100,000 fruit.
    overlays : str
        Kind of the annotated pictures: 'png', 'jpg', which takes a tenth of the time, or 'none'.
    """

    parquet: bool = False
    overlays: Overlays = "png"


@dataclass(eq=False)
class RunResult:
    """Result of a run.

    Parameters
    ----------
    out : Path
        Output folder.
    records : callable
        Returns a new iterator of the captures' records, in order.
    failures : list of Failure
        Captures that could not be read, measured or written.
    summary : Summary
        Counts and lengths.
    notes : list of str
        Notes: inputs that were given twice, damaged records.
    before : int
        Number of captures measured by an earlier run.
    interrupted : bool
        Whether it ended before all captures were measured.
    """

    out: Path
    records: Callable[[], Iterator[JournalRecord]]
    failures: list[Failure] = field(default_factory=list)
    summary: Summary = field(default_factory=Summary)
    notes: list[str] = field(default_factory=list)
    before: int = 0
    interrupted: bool = False

    @property
    def captures(self) -> int:
        """Number of captures measured now or before, including those without fruit."""
        return self.summary.captures

    @cached_property
    def rows(self) -> list[dict[str, Cell]]:
        """The rows of `fields.fruit_row`, one per fruit, read from the journal on demand."""
        return list(self.each_row())

    def each_row(self) -> Iterator[dict[str, Cell]]:
        """Yield the rows one after the other."""
        return rows_of(self.records())

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 130 if interrupted, otherwise as `measurer.exit_code`."""
        return 130 if self.interrupted else exit_code(self.captures, self.failures)


def measure_inputs(
    inputs: Sequence[Path | str],
    out: Path | str,
    options: MeasureOptions,
    report: Report | None = None,
    batch: BatchOptions | None = None,
) -> RunResult:
    """Measure every capture of every input into a folder.

    `out` gets `measurements.csv`, `measurements.xlsx`, `measurements.json`, `overlays/` with one
    annotated picture a capture, `failures.csv`, and `journal/`. An error in one capture is
    recorded and the others are measured. Captures that the journal has with the same content,
    options and networks are not measured again.

    Parameters
    ----------
    inputs : sequence of Path or str
        Folders and files that `open_source` knows, or URLs of such.
    out : Path or str
        Folder or URL, created if missing. Its tables contain the captures of the inputs of this
        run, measured now or before.
    options : MeasureOptions
        Options of the run.
    report : callable, optional
        Called after each capture; for progress bars.
    batch : BatchOptions, optional
        Options of the loop.

    Returns
    -------
    RunResult

    Raises
    ------
    CucumberVisionError
        If `out` cannot be written or is in use by another run, or a network or the calibration
        cannot be loaded.
    """
    batch = batch or BatchOptions()
    if batch.parquet:
        import_arrow()
    folder = OutputFolder(as_path(out))
    with folder.locked(".lock"), Journal(folder) as journal:
        run = _Run(journal, folder, Measurer(options), batch)
        return run.measure([as_path(path) for path in inputs], report)


@dataclass(frozen=True)
class Task(Listed):
    """A capture of a run.

    Parameters
    ----------
    known_content : str
        Hash of the content that was already measured with the same options; empty if none was.
    """

    known_content: str = ""

    @property
    def place(self) -> str:
        """Key of the capture in the journal."""
        return place_of(self.ref.location or self.input, self.name)


class FolderWorker(Worker[JournalRecord]):
    """Measures captures that changed, draws them into a folder, and returns journal records.

    Parameters
    ----------
    measurer : Measurer
        The measurer.
    out : OutputFolder
        Folder for the pictures.
    overlays : str
        Kind of the pictures, as in `BatchOptions`.
    """

    def __init__(self, measurer: Measurer, out: OutputFolder, overlays: Overlays = "png") -> None:
        super().__init__(measurer)
        self._out, self._overlays = out, overlays

    def read(self, item: Item) -> Outcome[JournalRecord] | ReadCapture:
        """Read a capture, unless it was measured before."""
        if not isinstance(item, Task):
            return super().read(item)
        with each_file_read_once():
            content = content_of(item.ref.parts()) if item.ref.parts is not None else ""
            if self._is_known(item, content):
                return Outcome()
            read = super().read(item)
        if isinstance(read, Outcome):
            return read
        content = content or _content_of_capture(read.capture)
        return Outcome() if self._is_known(item, content) else replace(read, content=content)

    def _is_known(self, task: Task, content: str) -> bool:
        picture = self._picture(task.name)
        same = bool(content) and content == task.known_content
        return same and (not picture or self._out.has(picture))

    def make(self, result: CaptureResult, content: str) -> Outcome[JournalRecord]:
        """Return the record of a measured capture, and write its picture."""
        failures, capture = list(result.failures), result.capture
        record = picture = None
        if result.error is None:
            with Boundary(failures, capture.source, capture.name):
                content_json = capture_json(result, result.rows())
                digest = self.measurer.hashes.of(result.stages)
                stages, models = tuple(map(str, result.stages)), list(result.models)
                record = JournalRecord(
                    place="",
                    content=content,
                    stages=stages,
                    digest=digest,
                    capture=content_json,
                    failures=(),
                    models=models,
                    picture=None,
                )
        if record is not None:
            with Boundary(failures, capture.source, capture.name):
                picture = self.draw(result)
            record = replace(record, failures=tuple(failures), picture=picture)
        return Outcome(record, tuple(failures))

    def draw(self, result: CaptureResult) -> str:
        """Write the annotated picture, and return its name in the folder; empty without one."""
        import cv2

        from cucumbervision.pipeline.overlay import as_jpeg, draw_overlay

        if name := self._picture(result.capture.name):
            drawn = draw_overlay(result.capture, result.fruit)
            if self._overlays == "jpg":
                self._out.write(name, as_jpeg(drawn, result.capture.width))
            else:
                self._out.write(
                    name, cv2.imencode(".png", cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR))[1].tobytes()
                )
        return name

    def _picture(self, name: str) -> str:
        return "" if self._overlays == "none" else f"overlays/{name}.{self._overlays}"


def content_of(parts: Iterable[Path | bytes]) -> str:
    """Hash the files of a capture; empty if one cannot be read.

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
    """Hash a capture without files of its own, such as a frame of a recording."""
    frame_numbers = [capture.frame, capture.burst_frame, capture.burst_size, capture.timestamp_s]
    camera = [vars(capture.intrinsics), vars(capture.stop), capture.source]
    digest = hashlib.sha256(json.dumps(json_value([frame_numbers, camera])).encode())
    for array in (capture.color, capture.depth_m, *capture.masks):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@dataclass
class _Run:
    """State of a run."""

    journal: Journal
    out: OutputFolder
    measurer: Measurer
    batch: BatchOptions
    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    order: list[bytes] = field(default_factory=list)
    capture_names: list[tuple[tuple[str, ...], int | None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.result = RunResult(self.out.path, self._records)

    def measure(self, inputs: Sequence[Path], report: Report | None) -> RunResult:
        result = self.result
        if self.journal.damaged:
            damaged = f"{self.journal.damaged} records of the journal are damaged"
            result.notes.append(f"{self.out.path}: {damaged}; their captures are measured again")
        options, site = self.measurer.options, self.measurer.site
        paths = distinct(inputs, result.notes.append)
        listed = each_once(
            list_captures(paths, options.reading, self.batch.opener), result.notes.append
        )
        result.failures += plugin_failures(self.measurer)
        worker = FolderWorker(self.measurer, self.out, self.batch.overlays)
        tasks = map(self._task, listed)
        for task, outcome in measure_all(tasks, worker, self.batch.engine, self.batch.is_cancelled):
            step = self._take(task, outcome)
            if report is not None and step is not None:
                report(step)
        with Boundary(result.failures, str(self.out.path)):
            self.journal.flush()
        with Boundary(result.failures, options.instances):
            result.notes += instance_notes(options.instances, self.capture_names)
        result.notes += result.summary.doubts()
        provenance = provenance_of(options, result.summary.models, site, self.started)
        provenance["notes"] = result.notes
        result.failures += write_reports(
            self.out,
            self._records,
            result.summary,
            result.failures,
            provenance,
            fields=self.measurer.plugged.fields,
            parquet=self.batch.parquet,
        )
        return result

    def _task(self, entry: Item) -> Task | Failure:
        """Return a capture with the content hash of its journal record."""
        if isinstance(entry, Failure):
            return entry
        task = Task(entry.input, entry.ref, entry.name)
        record = self.journal.find(task.place)
        if record is None or record.picture is None:
            return task
        same = self.measurer.hashes.still_hold(record.stages, record.digest)
        return replace(task, known_content=record.content) if same else task

    def _take(self, task: Task | Failure, outcome: Outcome[JournalRecord]) -> Step | None:
        """Write a result to the journal, count it, and collect its failures."""
        name = task.name if isinstance(task, Task) else ""
        record, failures, before = outcome.value, list(outcome.failures), False
        if isinstance(task, Task) and record is None and not failures:
            if not task.known_content:
                self.result.interrupted = True
                return None
            record, before = self.journal.find(task.place), True
            failures += record.failures if record is not None else ()
            self.result.before += 1
        elif isinstance(task, Task) and record is not None:
            record, noted = replace(record, place=task.place), len(failures)
            with Boundary(failures, task.input, name):
                self.journal.append(record)
            record = record if len(failures) == noted else None
        if record is not None:
            self.result.summary.add(record.rows, record.models, record.capture.get("left_out"))
            self.order.append(bytes.fromhex(record.place))
            capture = record.capture
            names = (str(capture["name"]), str(capture.get("source") or ""))
            self.capture_names.append((names, capture.get("frame")))
        self.result.failures += failures
        return Step(name, record, before, tuple(failures))

    def _records(self) -> Iterator[JournalRecord]:
        return self.journal.records(place.hex() for place in self.order)
