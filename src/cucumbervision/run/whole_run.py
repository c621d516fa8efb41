"""Measure many captures into a folder, with a record of each finished capture, and tables."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from cucumbervision.errors import CucumberVisionError
from cucumbervision.files import as_path, each_file_read_once, json_value, read_bytes
from cucumbervision.run.batch import Item, LoopOptions, Outcome, Worker, measure_all
from cucumbervision.run.folder import CaptureRecord, OutputFolder
from cucumbervision.run.inputs import (
    Listed,
    distinct,
    each_once,
    instance_notes,
    label_file,
    labelled_once,
    list_captures,
)
from cucumbervision.run.measurer import (
    Boundary,
    CaptureResult,
    Failure,
    Measurer,
    exit_code,
    plugin_failures,
)
from cucumbervision.run.provenance import provenance_of
from cucumbervision.run.summary import Summary
from cucumbervision.run.tables import capture_json, import_arrow, rows_of, write_reports

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from cucumbervision.capture.frames import Capture
    from cucumbervision.run.fields import Cell
    from cucumbervision.run.options import MeasureOptions


_JPEG_QUALITY = 85

Report: TypeAlias = Callable[[Outcome[CaptureRecord]], None]
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
    failures : list of Failure
        Captures that could not be read, measured or written.
    summary : Summary
        Counts and lengths.
    notes : list of str
        Notes, such as inputs that were given twice.
    before : int
        Number of captures measured by an earlier run.
    interrupted : bool
        Whether it ended before all captures were measured.
    """

    out: Path
    failures: list[Failure] = field(default_factory=list)
    summary: Summary = field(default_factory=Summary)
    notes: list[str] = field(default_factory=list)
    before: int = 0
    interrupted: bool = False

    def __post_init__(self) -> None:
        self._names: list[str] = []  # a batch may be larger than the memory

    def add(self, record: CaptureRecord) -> None:
        """Count a capture."""
        self.summary.add(record.rows, record.models, record.capture.get("left_out"))
        self.before += record.is_earlier
        self._names.append(str(record.capture["name"]))

    def records(self) -> Iterator[CaptureRecord]:
        """Yield the captures' records, in order, from the output folder."""
        yield from filter(None, map(OutputFolder(self.out).find, self._names))

    @property
    def captures(self) -> int:
        """Number of captures measured now or before, including those without fruit."""
        return self.summary.captures

    @cached_property
    def rows(self) -> list[dict[str, Cell]]:
        """The rows of `fields.fruit_row`, one per fruit."""
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
    annotated picture a capture, `failures.csv`, and `records/` with a JSON file a capture. An error
    in one capture is recorded and the others are measured. Captures whose record is there, and made
    of the same files, options, networks and code, are not measured again. A run that reads no
    capture leaves earlier tables as they are.

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
    with folder.locked(".lock"):
        paths = [as_path(path) for path in inputs]
        return _measured(folder, Measurer(options), batch, paths, report)


class FolderWorker(Worker[CaptureRecord]):
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

    def read(self, item: Item) -> Outcome[CaptureRecord] | tuple[Capture, str]:
        """Read a capture, or its record if it was measured before."""
        if isinstance(item, Failure):
            return super().read(item)
        with each_file_read_once():
            content = content_of(item.ref.parts()) if item.ref.parts is not None else ""
            if content and (record := self._earlier(item.name, content)) is not None:
                return Outcome(record, record.failures)
            read = super().read(item)
        if isinstance(read, Outcome):
            return read
        content = content or _content_of_capture(read[0])
        record = self._earlier(item.name, content)
        if record is not None:
            return Outcome(record, record.failures)
        return read[0], content

    def _earlier(self, name: str, content: str) -> CaptureRecord | None:
        """Return the record of a capture if it would be made so again."""
        record, picture = self._out.find(name), self._picture(name)
        if record is None or record.picture is None or record.key != self._key(content):
            return None
        return None if picture and not self._out.has(picture) else record

    def _key(self, content: str) -> str:
        return f"{self.measurer.deciding_sha256} {content}"

    def make(self, result: CaptureResult, content: str) -> Outcome[CaptureRecord]:
        """Return the record of a measured capture; it and its picture are written."""
        failures, capture = list(result.failures), result.capture
        if result.error is not None:
            return Outcome(None, tuple(failures))
        picture = None
        with Boundary(failures, capture.source, capture.name):
            picture = self.draw(result)
        saved = False
        with Boundary(failures, capture.source, capture.name):
            record = CaptureRecord(
                key=self._key(content),
                capture=capture_json(result, result.rows()),
                failures=tuple(failures),
                models=list(result.models),
                picture=picture,
            )
            self._out.save(capture.name, record)
            saved = True
        return Outcome(record if saved else None, tuple(failures))

    def draw(self, result: CaptureResult) -> str:
        """Write the annotated picture, and return its name in the folder; empty without one."""
        import cv2

        from cucumbervision.run.overlay import draw_overlay

        if name := self._picture(result.capture.name):
            drawn = cv2.cvtColor(draw_overlay(result.capture, result.fruit), cv2.COLOR_RGB2BGR)
            quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if self._overlays == "jpg" else []
            self._out.write(name, cv2.imencode(f".{self._overlays}", drawn, quality)[1].tobytes())
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


def _measured(
    out: OutputFolder,
    measurer: Measurer,
    batch: BatchOptions,
    inputs: Sequence[Path],
    report: Report | None,
) -> RunResult:
    started, options = datetime.now(UTC), measurer.options
    result = RunResult(out.path, failures=plugin_failures(measurer))
    names: list[tuple[tuple[str, ...], int | None]] = []
    paths = distinct(inputs, result.notes.append)
    listed = each_once(list_captures(paths, options.reading, batch.opener), result.notes.append)
    labels = label_file(options.instances)
    listed = labelled_once(labels, listed)
    worker = FolderWorker(measurer, out, batch.overlays)
    for item, outcome in measure_all(listed, worker, batch.engine, batch.is_cancelled):
        record = outcome.value
        if isinstance(item, Listed) and record is None and not outcome.failures:  # cancelled before
            record = out.find(item.name)
            if record is None or not record.key.startswith(measurer.deciding_sha256):
                result.interrupted = True
                continue
        result.failures += outcome.failures
        if record is not None:
            result.add(record)
            capture = record.capture
            source = str(capture.get("source") or "")
            names.append(((str(capture["name"]), source), capture.get("frame")))
        if report is not None:
            report(Outcome(record, outcome.failures))
    if labels is not None:
        with Boundary(result.failures, options.instances):
            result.notes += instance_notes(labels, names)
    result.notes += result.summary.doubts()
    if not result.captures and out.has("measurements.csv"):
        result.notes.append(f"{out.path}: nothing was read, so its tables stay as they were")
        return result
    provenance = provenance_of(options, result.summary.models, measurer.site, started)
    provenance["notes"] = result.notes
    result.failures += write_reports(
        out,
        result.records,
        result.summary,
        result.failures,
        provenance,
        fields=measurer.plugged.fields,
        parquet=batch.parquet,
    )
    return result
