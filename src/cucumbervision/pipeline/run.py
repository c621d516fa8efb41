"""Measure many captures: one after the other, each written before the next is read."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import unique_name
from cucumbervision.errors import CucumberVisionError
from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.pipeline.measurer import Boundary, CaptureResult, Failure, Measurer, exit_code
from cucumbervision.pipeline.tables import (
    FAILURE_COLUMNS,
    CsvSink,
    capture_json,
    provenance_of,
    summary_lines,
    write_json,
    write_workbook,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureSource, ReadOptions
    from cucumbervision.pipeline.fields import Cell
    from cucumbervision.pipeline.options import MeasureOptions

_log = logging.getLogger(__name__)

__all__ = [
    "Folder",
    "Overlays",
    "RunResult",
    "Sink",
    "count_captures",
    "measure_all",
    "measure_inputs",
    "read_captures",
]

Opener: TypeAlias = Callable[["Path", "ReadOptions"], "CaptureSource"]
Report: TypeAlias = Callable[["CaptureResult | Failure"], None]


class Sink(Protocol):
    """Where results go: tables, pictures, a store."""

    def add(self, result: CaptureResult) -> None:
        """Take one capture; what it raises becomes a failure of that capture."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """What one run gave.

    Parameters
    ----------
    rows : list of dict
        One a fruit, as `fields.fruit_row` fills them.
    failures : list of Failure
        What could not be read, measured or written.
    captures : int
        How many captures were measured, those without fruit included.
    out : Path
        Where the files are.
    """

    rows: list[dict[str, Cell]] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    captures: int = 0
    out: Path = Path()

    @property
    def exit_code(self) -> int:
        """What the command's exit code is: 0, 1, 2 or 70, as in `measurer.exit_code`."""
        return exit_code(self.captures, self.failures)


def read_captures(
    inputs: Iterable[Path], reading: ReadOptions, opener: Opener = open_source
) -> Iterator[Capture | Failure]:
    """Read the captures of all inputs, each when its turn comes.

    Parameters
    ----------
    inputs : iterable of Path
        Folders and files that `open_source` knows.
    reading : ReadOptions
        What is said of them.
    opener : callable
        Opens each input; `intake.recordings.open_guarded` for untrusted recordings.

    Yields
    ------
    Capture or Failure
        A capture, or why one or a whole input cannot be read.
    """
    for path in _once(inputs, say=True):
        failures: list[Failure] = []
        refs = None
        with Boundary(failures, str(path)):
            refs = iter(opener(path, reading))
        while refs is not None:
            ref = capture = None
            with Boundary(failures, str(path)):
                ref = next(refs, None)
            if ref is None:  # the end, or the source itself broke: nothing more will come
                break
            with Boundary(failures, str(path), ref.name):
                capture = ref.load()
            yield from failures
            failures.clear()
            if capture is not None:
                yield capture
        yield from failures


def _once(inputs: Iterable[Path], *, say: bool = False) -> Iterator[Path]:
    """Yield each input once, by whatever way it is named; say which were left out."""
    seen = set[Path]()
    for path in inputs:
        whole = path.absolute()
        with suppress(OSError, RuntimeError):  # a loop of links is its reader's to name
            whole = path.resolve()
        if whole not in seen:
            yield path
        elif say:
            _log.warning("%s is given twice: it is measured once", path)
        seen.add(whole)


def _named_apart(captures: Iterable[Capture | Failure]) -> Iterator[Capture | Failure]:
    taken: set[str] = set()
    for one in captures:
        if isinstance(one, Failure):
            yield one
        else:
            yield replace(one, name=unique_name(one.name, taken))


def count_captures(
    inputs: Sequence[Path], reading: ReadOptions, opener: Opener = open_source
) -> int | None:
    """Return how many captures the inputs hold; None where only reading them would tell."""
    total = 0
    for path in _once(inputs):
        source = None
        with Boundary([], str(path)):
            source = opener(path, reading)
        if source is not None and source.total is None:
            return None
        # The failure of one that cannot be opened is reported as one step.
        total += 1 if source is None else source.total or 0
    return total


def measure_all(
    captures: Iterable[Capture | Failure],
    measurer: Measurer,
    sinks: Sequence[Sink],
    note: Callable[[Failure], None],
    report: Report | None = None,
) -> int:
    """Measure captures into sinks; whatever goes wrong in one, the others go on.

    Parameters
    ----------
    captures : iterable of Capture or Failure
        As `read_captures` yields them.
    measurer : Measurer
        What measures.
    sinks : sequence of Sink
        Each gets every capture that was measured.
    note : callable
        Called with each failure.
    report : callable, optional
        Called after each capture, with its result or its failure; for progress bars.

    Returns
    -------
    int
        How many captures were measured and taken by the first sink.
    """
    measured = 0
    for read in captures:
        done = read if isinstance(read, Failure) else measurer.attempt(read)
        failures = [done] if isinstance(done, Failure) else list(done.failures)
        if isinstance(done, CaptureResult) and done.error is None:
            name = done.capture.source, done.capture.name
            for number, sink in enumerate(sinks):
                before = len(failures)
                with Boundary(failures, *name):
                    sink.add(done)
                measured += number == 0 and len(failures) == before
        for failure in failures:
            note(failure)
        if report is not None:
            report(done)
    return measured


class Folder:
    """A folder of tables and pictures while it fills: the sink of `cucumbervision measure`.

    Parameters
    ----------
    out : Path
        Made where it is missing; its tables are written anew.

    Raises
    ------
    CucumberVisionError
        If it cannot be written.
    """

    def __init__(self, out: Path) -> None:
        self.rows: list[dict[str, Cell]] = []
        self.failures: list[Failure] = []
        self._captures: list[dict[str, Any]] = []
        self._out, self._started = out, datetime.now(UTC)
        self._stack = ExitStack()
        try:
            (out / "overlays").mkdir(parents=True, exist_ok=True)
            names = [one.name for one in FIELDS]
            self._table = self._stack.enter_context(CsvSink(out / "measurements.csv", names))
            failures = CsvSink(out / "failures.csv", FAILURE_COLUMNS)
            self._failures = self._stack.enter_context(failures)
        except OSError as error:
            self._stack.close()
            raise CucumberVisionError(
                f"cannot be written ({error.strerror})", source=out, remedy="choose another --out"
            ) from error

    def add(self, result: CaptureResult) -> None:
        """Append a capture's fruit to the tables."""
        rows = result.rows()
        self._table.write(*rows)
        self.rows += rows
        self._captures.append(capture_json(result, rows))

    def note(self, failure: Failure) -> None:
        """Append a line to `failures.csv`."""
        self.failures.append(failure)
        with suppress(OSError):  # a full disk: the failures are still shown at the end
            self._failures.write(vars(failure))

    def finish(self, measurer: Measurer) -> None:
        """Write `measurements.json` and `measurements.xlsx` of the whole run."""
        failures = self.failures
        provenance = provenance_of(measurer, self._started)
        failed = [vars(failure) for failure in failures]
        report = {**provenance, "captures": self._captures, "failures": failed}
        write_json(self._out / "measurements.json", report)
        lines = summary_lines(self.rows, len(self._captures), failures, provenance)
        write_workbook(self._out / "measurements.xlsx", self.rows, lines)

    def close(self) -> None:
        """Close the tables."""
        self._stack.close()


class Overlays:
    """Annotated pictures in a folder, one PNG a capture."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, result: CaptureResult) -> None:
        """Draw a capture's fruit and write the picture."""
        import cv2

        from cucumbervision.pipeline.overlay import draw_overlay

        ok, data = cv2.imencode(".png", draw_overlay(result.capture, result.fruit)[..., ::-1])
        if ok:
            (self._folder / f"{result.capture.name}.png").write_bytes(data.tobytes())


def measure_inputs(
    inputs: Sequence[Path],
    out: Path,
    options: MeasureOptions,
    report: Report | None = None,
    opener: Opener = open_source,
) -> RunResult:
    """Measure every capture of every input into a folder.

    `out` gets `measurements.csv`, `measurements.xlsx`, `measurements.json`, `overlays/` with one
    annotated PNG a capture, and `failures.csv`. Whatever goes wrong in one capture is noted and
    the others go on.

    Parameters
    ----------
    inputs : sequence of Path
        Folders and files that `open_source` knows.
    out : Path
        Made where it is missing; its tables are written anew.
    options : MeasureOptions
        The run's choices.
    report : callable, optional
        Called after each capture with its result or failure; for progress bars.
    opener : callable
        Opens each input; `intake.recordings.open_guarded` for untrusted recordings.

    Returns
    -------
    RunResult

    Raises
    ------
    CucumberVisionError
        If the run cannot start at all: `out` cannot be written, or a network or the calibration
        cannot be loaded.
    """
    measurer = Measurer(options)
    measurer.load()
    folder = Folder(out)
    try:
        captures = _named_apart(read_captures(inputs, options.reading, opener))
        sinks = (folder, Overlays(out / "overlays"))
        measured = measure_all(captures, measurer, sinks, folder.note, report)
    finally:
        folder.close()
    with Boundary(folder.failures, str(out)):
        folder.finish(measurer)
    return RunResult(folder.rows, folder.failures, measured, out)
