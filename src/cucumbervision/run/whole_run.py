"""Measure many captures into a folder, with a record of each finished capture, and tables."""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import tempfile
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from cucumbervision import files
from cucumbervision.about import code_sha256, installed_versions, software
from cucumbervision.accuracy.calibration_file import SiteCalibration
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import encoded
from cucumbervision.capture.source import CaptureRef
from cucumbervision.errors import CucumberVisionError, wrap_os_errors
from cucumbervision.networks.registry import Registry, file_sha256
from cucumbervision.plugins import Plugin, plugins
from cucumbervision.run import batch as loop
from cucumbervision.run import tables
from cucumbervision.run.fields import Cell, Field
from cucumbervision.run.measurer import (
    Boundary,
    CaptureResult,
    Failure,
    Measurer,
    exit_code,
    plugin_failures,
)
from cucumbervision.run.options import INSTANCE_SOURCES, MeasureOptions
from cucumbervision.run.overlay import draw_overlay
from cucumbervision.tube.compiled import kernel_name

RECORDS = "records"
"""Folder of the records, a JSON file a capture."""

_BESIDE_CELLS = frozenset({"pose", "methods"})  # of a fruit of `measurements.json`
_JPEG_QUALITY = 85


@dataclass(frozen=True, kw_only=True)
class CaptureRecord:
    """A finished capture.

    Parameters
    ----------
    key : str
        Hash of all that decides its result, and that of its own files.
    capture : dict
        The capture with its fruit, as in `measurements.json`.
    failures : tuple of Failure
        Rejected instances, and files that could not be written.
    models : list of dict
        The networks that were used.
    picture : str, optional
        Its annotated image in the output folder; empty if none was asked for, None if it could
        not be written, so that the capture counts as incomplete.
    is_earlier : bool
        Whether an earlier run measured it.
    """

    key: str
    capture: dict[str, Any]
    failures: tuple[Failure, ...]
    models: list[dict[str, Any]]
    picture: str | None
    is_earlier: bool = False

    @property
    def rows(self) -> list[dict[str, Cell]]:
        """The rows of the table of fruit."""
        return [
            {name: cell for name, cell in fruit.items() if name not in _BESIDE_CELLS}
            for fruit in self.capture["fruit"]
        ]

    @property
    def value(self) -> CaptureRecord:
        """The record itself; deprecated, as reports of 0.1.0 had it in an outcome."""
        warnings.warn("a report gets the record itself", DeprecationWarning, stacklevel=2)
        return self

    def as_text(self) -> str:
        """Return the record as one line of JSON."""
        values = {**vars(self), "failures": [vars(failure) for failure in self.failures]}
        return json.dumps(values, ensure_ascii=False, separators=(",", ":"))

    @classmethod
    def of_text(cls, text: str | bytes) -> CaptureRecord:
        """Return the record that `as_text` wrote."""
        values = json.loads(text)
        values["failures"] = tuple(Failure(**failure) for failure in values["failures"])
        return cls(**values)


class OutputFolder:
    """A local folder, or one on a store that fsspec supports.

    Files are replaced atomically. When `write` and `replacing` return, the content is on disk (or
    acknowledged by the store).

    Parameters
    ----------
    path : Path
        Location, as `as_path` returns it.

    Examples
    --------
    >>> out = OutputFolder(Path(tempfile.mkdtemp()))
    >>> out.write("overlays/a.png", b"picture")
    >>> out.has("overlays/a.png"), (out.path / "overlays/a.png").read_bytes()
    (True, b'picture')
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._unfinished = path / ".unfinished"

    def has(self, name: str) -> bool:
        """Return whether a file of that name exists."""
        return files.with_retries(self.path, (self.path / name).exists)

    def write(self, name: str, data: bytes) -> None:
        """Write a file.

        Raises
        ------
        OSError
            If it cannot be written; what was there before is still there.
        """
        with self.replacing(name) as path:
            path.write_bytes(data)

    @contextmanager
    def replacing(self, name: str) -> Iterator[Path]:
        """Yield a local temporary file, which replaces the named file when the block succeeds.

        Raises
        ------
        OSError
            If it cannot be written; what was there before is still there.
        """
        target: Any = self.path / name
        if files.is_remote(self.path):
            with tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
                filled = Path(folder) / Path(name).name
                yield filled
                files.with_retries(target, lambda: target.fs.put_file(str(filled), target.path))
            return
        for place in (target.parent, self._unfinished):
            place.mkdir(parents=True, exist_ok=True)
        with files.replacing(target, self._unfinished) as filled:
            yield filled

    def find(self, name: str) -> CaptureRecord | None:
        """Return the record of a capture; None if there is none, or it is damaged."""
        path = self.path / RECORDS / f"{name}.json"
        # Neither JSON nor its text, or JSON of something else: the capture is measured again.
        with suppress(FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
            return replace(
                CaptureRecord.of_text(files.with_retries(path, path.read_bytes)), is_earlier=True
            )
        return None

    @contextmanager
    def locked(self, name: str) -> Iterator[None]:
        """Lock the folder against other programs during the block, if the system can lock files.

        What killed programs left half written is removed.

        Raises
        ------
        CucumberVisionError
            If another program has locked it, or it cannot be written.
        """
        with wrap_os_errors("cannot be written", self.path, "choose another --out"):
            if files.is_remote(self.path):  # reports immediately if the store is read-only
                self.write(name, b"")
            else:
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                file = (self.path / name).open("a")
        try:
            import fcntl
        except ModuleNotFoundError:  # Windows
            fcntl = None  # type: ignore[assignment]
        if files.is_remote(self.path) or fcntl is None:
            yield
            return
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise CucumberVisionError(
                    "another run is writing into it",
                    source=self.path,
                    remedy="wait until it ends, or choose another --out",
                ) from None
            shutil.rmtree(self._unfinished, ignore_errors=True)
            try:
                yield
            finally:
                with suppress(OSError):
                    self._unfinished.rmdir()


Report: TypeAlias = Callable[[CaptureRecord | Failure], None]
Overlays: TypeAlias = Literal["png", "jpg", "none"]
"""Kind of the annotated images."""


@dataclass(frozen=True)
class BatchOptions(loop.LoopOptions):
    """Options of a run that do not change rows.

    Parameters
    ----------
    engine, is_cancelled
        As in `LoopOptions`.
    parquet : bool
        Also write `parquet/`, in parts of 100,000 fruit.
    overlays : str
        Kind of the annotated images: 'png', 'jpg', which takes a tenth of the time, or 'none'.
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
    summary: tables.Summary = field(default_factory=tables.Summary)
    notes: list[str] = field(default_factory=list)
    before: int = 0
    interrupted: bool = False
    # A batch may be larger than the memory: only the names of its captures are held.
    _names: list[str] = field(default_factory=list, init=False)

    def add(self, record: CaptureRecord) -> None:
        """Count a capture."""
        self.summary.add(record.rows, record.models, record.capture.get("left_out"))
        self.failures += record.failures
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
        return (row for record in self.records() for row in record.rows)

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
    annotated image a capture, `failures.csv`, and `records/` with a JSON file a capture. An error
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
        tables.import_arrow()
    folder = OutputFolder(files.as_path(out))
    with folder.locked(".lock"):
        paths = [files.as_path(path) for path in inputs]
        return _measured(folder, Measurer(options), batch, paths, report)


class FolderWorker(loop.Worker[CaptureRecord]):
    """Measures captures that changed, and writes their images and records into a folder.

    Parameters
    ----------
    measurer : Measurer
        The measurer.
    out : OutputFolder
        Folder of the run.
    overlays : str
        Kind of the images, as in `BatchOptions`.
    """

    def __init__(self, measurer: Measurer, out: OutputFolder, overlays: Overlays = "png") -> None:
        super().__init__(measurer)
        self._out, self._overlays = out, overlays
        self.deciding = deciding_sha256(
            measurer.options, measurer.registry, measurer.plugged.lines, measurer.site
        )

    def __call__(self, item: loop.Item) -> CaptureRecord | Failure:
        """Return the record of a capture if it would be made so again; otherwise measure it."""
        content, earlier = "", None
        with files.each_file_read_once():
            if isinstance(item, CaptureRef) and item.parts:
                content = content_of(item.parts())
                earlier = self._earlier(item.name, content)
            read = earlier or loop.load(item)
        if not isinstance(read, Capture):
            return read
        if not content:
            content = _content_of_capture(read)
            earlier = self._earlier(read.name, content)
        return earlier or self.measure(read, content)

    def _earlier(self, name: str, content: str) -> CaptureRecord | None:
        """Return the record of a capture with this content, if it is complete."""
        record, picture = self._out.find(name), self._picture(name)
        if record is None or record.picture is None or record.key != f"{self.deciding} {content}":
            return None
        return None if picture and not self._out.has(picture) else record

    def measure(self, capture: Capture, content: str = "") -> CaptureRecord | Failure:
        """Measure a capture, and write its record and image."""
        content = content or _content_of_capture(capture)
        self.measurer.load()
        result = self.measurer.attempt(capture)
        failures, capture = list(result.failures), result.capture
        if result.error is not None:
            return failures[0]
        picture = None
        with Boundary(failures, capture.source, capture.name):
            picture = self.draw(result)
        with Boundary(failures, capture.source, capture.name):
            record = CaptureRecord(
                key=f"{self.deciding} {content}",
                capture=tables.capture_json(result, result.rows()),
                failures=tuple(failures),
                models=list(result.models),
                picture=picture,
            )
            text = record.as_text().encode(errors="surrogatepass")
            self._out.write(f"{RECORDS}/{capture.name}.json", text)
            return record
        return failures[-1]

    def draw(self, result: CaptureResult) -> str:
        """Write the annotated image, and return its name in the folder; empty without one."""
        if name := self._picture(result.capture.name):
            drawn = draw_overlay(result.capture, result.fruit)
            self._out.write(name, encoded(drawn, f".{self._overlays}", _JPEG_QUALITY))
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
            name, data = (
                ("", part) if isinstance(part, bytes) else (part.name, files.read_bytes(part))
            )
            digest.update(f"{len(data)} {name}\n".encode(errors="surrogatepass"))
            digest.update(data)
    except (CucumberVisionError, OSError):  # loading it raises the error
        return ""
    return digest.hexdigest()


def _content_of_capture(capture: Capture) -> str:
    """Hash a capture without files of its own, such as a frame of a recording."""
    frame_numbers = [capture.frame, capture.burst_frame, capture.burst_size, capture.timestamp_s]
    camera = [vars(capture.intrinsics), vars(capture.stop), capture.source]
    digest = hashlib.sha256(json.dumps(files.json_value([frame_numbers, camera])).encode())
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
    note, labels = result.notes.append, loop.Labels(options.instances)
    listed = loop.each_once(loop.list_captures(inputs, options.reading, say=note), note)
    worker = FolderWorker(measurer, out, batch.overlays)
    for item, done in loop.measure_all(
        labels.checked(listed), worker, batch.engine, batch.is_cancelled
    ):
        if done is None and isinstance(item, CaptureRef):  # cancelled before its turn
            done = out.find(item.name)
            if done is None or not done.key.startswith(worker.deciding):
                result.interrupted = True
                continue
        if isinstance(done, CaptureRecord):
            result.add(done)
        elif done is not None:
            result.failures.append(done)
        if report is not None and done is not None:
            report(done)
    with Boundary(result.failures, options.instances):
        result.notes += labels.notes()
    result.notes += result.summary.doubts()
    if not result.captures and out.has("measurements.csv"):
        result.notes.append(f"{out.path}: nothing was read, so its tables stay as they were")
        return result
    provenance = provenance_of(options, result.summary.models, measurer.site, started)
    provenance["notes"] = result.notes
    _write_tables(out, result, provenance, measurer.plugged.fields, parquet=batch.parquet)
    return result


_PART_ROWS = 100_000


def _write_tables(
    out: OutputFolder,
    result: RunResult,
    provenance: Mapping[str, Any],
    fields: Sequence[Field],
    *,
    parquet: bool,
) -> None:
    """Write the tables of a run; one that fails keeps its previous version and is a failure."""
    written: list[Failure] = []
    with Boundary(written, str(out.path)), out.replacing("measurements.csv") as path:
        files.write_csv(path, [fruit_field.name for fruit_field in fields], result.each_row())
    with (
        Boundary(written, str(out.path)),
        out.replacing("measurements.json") as path,
        path.open("w", encoding="utf-8", errors="backslashreplace") as file,
    ):
        file.writelines(_json_pieces(provenance, result.records(), result.failures))
    with Boundary(written, str(out.path)), out.replacing("measurements.xlsx") as path:
        summary, failures = result.summary, len(result.failures)
        lines = [*tables.excel_limit(summary.fruit), *summary.lines(failures, provenance)]
        tables.write_workbook(path, result.each_row(), lines, fields=fields)
    if parquet:
        with Boundary(written, str(out.path)):
            _write_parts(out, result.each_row(), provenance, fields)
    result.failures += written
    with Boundary(result.failures, str(out.path)), out.replacing("failures.csv") as path:
        files.write_csv(path, tables.FAILURE_COLUMNS, map(vars, result.failures))


def _json_pieces(
    provenance: Mapping[str, Any], records: Iterable[CaptureRecord], failures: Iterable[Failure]
) -> Iterator[str]:
    """Yield the text of `measurements.json` by capture, one value per line."""
    yield json.dumps(dict(provenance), indent=1, ensure_ascii=False).removesuffix("\n}")
    yield ',\n "captures": ['
    yield from _json_items(record.capture for record in records)
    yield ',\n "failures": ['
    yield from _json_items(vars(failure) for failure in failures)
    yield "\n}\n"


def _json_items(values: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    first = True
    for value in values:
        text = json.dumps(value, indent=1, ensure_ascii=False).replace("\n", "\n  ")
        yield f"{'' if first else ','}\n  {text}"
        first = False
    yield "]" if first else "\n ]"


def _write_parts(
    out: OutputFolder,
    rows: Iterator[dict[str, Cell]],
    provenance: Mapping[str, Any],
    fields: Sequence[Field],
) -> None:
    """Write `parquet/part-00000.parquet` and so on, and remove further parts of an earlier run."""
    names = set[str]()
    # Without fruit, one empty part defines the columns.
    while (part := list(islice(rows, _PART_ROWS))) or not names:
        name = f"part-{len(names):05d}.parquet"
        with out.replacing(f"parquet/{name}") as path:
            tables.write_parquet(path, fields, part, provenance)
        names.add(name)
    for old in (out.path / "parquet").glob("part-*.parquet"):
        if old.name not in names:
            old.unlink()


def deciding_sha256(
    options: MeasureOptions,
    registry: Registry,
    added: Sequence[Plugin] = (),
    site: SiteCalibration | None = None,
) -> str:
    """Return the hash of all that decides lengths besides the captures' own files.

    These are the content of the code and its tables, of the networks, and of the files that the
    options name; the options; the versions of libraries; and the plug-ins.

    Parameters
    ----------
    options : MeasureOptions
        Options of the run.
    registry : Registry
        The networks.
    added : sequence of Plugin
        Plug-ins of other packages. One without a version may have changed: no hash is the same.
    site : SiteCalibration, optional
        The calibration that the run has read.

    Raises
    ------
    CucumberVisionError
        If a file in the options cannot be read.

    Examples
    --------
    >>> from cucumbervision.networks.registry import load_registry
    >>> from cucumbervision.run.options import MeasureOptions
    >>> one, other = (
    ...     deciding_sha256(MeasureOptions(confidence=c), load_registry()) for c in (0.3, 0.1)
    ... )
    >>> one == other
    False
    """
    values = options.as_json()
    for name in ("intrinsics", "depth"):  # files of the capture
        del values["reading"][name]
    named = plugins("detectors") | plugins("segmenters")
    added = [*added, *(named[n] for n in (options.instances, options.segmenter) if n in named)]
    paths = [options.pose] if options.pose else []
    if options.instances not in (*INSTANCE_SOURCES, *named):
        paths.append(Path(options.instances))
    if not all(plugin.version for plugin in added):
        values["run"] = uuid.uuid4().hex
    values |= {
        "calibration": site and site.sha256,
        "files": [_path_sha256(path) for path in paths],
        "networks": [registry.hashes(model.name) for model in registry.models],
        "plugins": [plugin.as_json() for plugin in added],
        "code": code_sha256(),
        "versions": installed_versions(),
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _path_sha256(path: Path) -> str:
    """Hash a file, or all files of a folder with their names."""
    if not path.exists():
        raise CucumberVisionError("no such file", source=path, remedy="check the run's options")
    if path.is_file():
        return file_sha256(path)
    members = sorted(file for file in path.rglob("*") if file.is_file())
    named = [[file.relative_to(path).as_posix(), file_sha256(file)] for file in members]
    return hashlib.sha256(json.dumps(named).encode()).hexdigest()


def provenance_of(
    options: MeasureOptions,
    models: Sequence[Mapping[str, Any]],
    site: SiteCalibration | None,
    started: datetime,
) -> dict[str, Any]:
    """Return the provenance of a run: software, options, networks, calibration, versions."""
    return {
        **software(),
        "started": started.isoformat(timespec="seconds"),
        "config": options.as_json(),
        "config_sha256": options.sha256,
        "code_sha256": code_sha256(),
        "models": [model for model in models if "package" not in model],
        "plugins": [model for model in models if "package" in model],
        "calibration": site and {"tag": site.tag, **site.model_dump(mode="json")},
        "kernel": kernel_name(),
        "versions": {"python": platform.python_version(), **installed_versions()},
    }
