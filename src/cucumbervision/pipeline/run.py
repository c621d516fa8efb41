"""Measure many captures into a folder: each journalled when it is done, tables at the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.urls import as_path
from cucumbervision.errors import InstancesError
from cucumbervision.perception.instance_files import read_instances
from cucumbervision.pipeline.engines import in_process
from cucumbervision.pipeline.inputs import distinct, each_once, list_captures
from cucumbervision.pipeline.journal import JOURNAL, Journal, JournalRecord
from cucumbervision.pipeline.measurer import Boundary, Failure, exit_code
from cucumbervision.pipeline.options import INSTANCE_SOURCES
from cucumbervision.pipeline.output import OutputFolder
from cucumbervision.pipeline.stages import StageHashes
from cucumbervision.pipeline.summary import Summary
from cucumbervision.pipeline.tables import (
    TABLES,
    import_arrow,
    provenance_of,
    rows_of,
    write_reports,
)
from cucumbervision.pipeline.work import Batch, Outcome, Task

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from cucumbervision.pipeline.engines import Engine
    from cucumbervision.pipeline.fields import Cell
    from cucumbervision.pipeline.inputs import Listed, Opener
    from cucumbervision.pipeline.options import MeasureOptions

Report: TypeAlias = Callable[[Outcome], None]


@dataclass(frozen=True)
class BatchOptions:
    """How a run goes about it; none of it changes a row.

    Parameters
    ----------
    fresh : bool
        Begin anew: what the folder holds is put aside in `earlier/`.
    parquet : bool
        Write `parquet/`, too: parts of 100,000 fruit.
    stop : callable
        Asked before each capture whether to end after those that are being measured.
    opener : callable
        Opens each input; `intake.recordings.open_guarded` for untrusted recordings.
    engine : Engine
        Where the work is done.
    """

    fresh: bool = False
    parquet: bool = False
    stop: Callable[[], bool] = lambda: False
    opener: Opener = open_source
    engine: Engine = in_process


@dataclass(frozen=True, eq=False)
class RunResult:
    """What one run gave.

    Parameters
    ----------
    failures : list of Failure
        What could not be read, measured or written.
    summary : Summary
        Counts and lengths.
    before : int
        How many captures an earlier run had measured.
    notes : list of str
        What else to know: inputs that were named twice, records that were damaged.
    interrupted : bool
        Whether it ended before all was measured.
    out : Path
        Where the files are.
    records : callable
        Begins anew with the captures' records, in order.
    """

    failures: list[Failure]
    summary: Summary
    before: int
    notes: list[str]
    interrupted: bool
    out: Path
    records: Callable[[], Iterator[JournalRecord]]

    @property
    def captures(self) -> int:
        """How many captures were measured, now or before, those without fruit included."""
        return self.summary.captures

    @cached_property
    def rows(self) -> list[dict[str, Cell]]:
        """One row a fruit, as `fields.fruit_row` fills them; read from the journal when asked."""
        return list(self.each_row())

    def each_row(self) -> Iterator[dict[str, Cell]]:
        """Yield the rows one after the other."""
        return rows_of(self.records())

    @property
    def exit_code(self) -> int:
        """What the command's exit code is: 130 if interrupted, else as `measurer.exit_code`."""
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
    annotated PNG a capture, `failures.csv`, and `journal/`. Whatever goes wrong in one capture is
    noted and the others go on. What the journal has already, of the same content and by the same
    options and networks, is not measured again.

    Parameters
    ----------
    inputs : sequence of Path or str
        Folders and files that `open_source` knows, or URLs of such.
    out : Path or str
        Folder or URL; made where it is missing. Its tables hold the captures of this run's
        inputs, measured now or before.
    options : MeasureOptions
        The run's choices.
    report : callable, optional
        Called after each capture with its outcome; for progress bars.
    batch : BatchOptions, optional
        How to go about it.

    Returns
    -------
    RunResult

    Raises
    ------
    CucumberVisionError
        If the run cannot start at all: `out` cannot be written or another run writes into it, or
        a network or the calibration cannot be loaded.
    """
    batch = batch or BatchOptions()
    if batch.parquet:
        import_arrow()
    folder = OutputFolder(as_path(out))
    with folder.alone(".lock"):
        if batch.fresh:
            folder.put_aside([JOURNAL, *TABLES, "overlays"])
        with Journal(folder) as journal:
            run = _Run(journal, folder, options, batch)
            return run.measure([as_path(path) for path in inputs], report)


@dataclass
class _Run:
    """One run while it goes."""

    journal: Journal
    out: OutputFolder
    options: MeasureOptions
    batch: BatchOptions
    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    summary: Summary = field(default_factory=Summary)
    failures: list[Failure] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    order: list[bytes] = field(default_factory=list)
    before: int = 0
    listed: int = 0
    taken: int = 0
    seen: list[tuple[tuple[str, ...], int | None]] = field(default_factory=list)

    def measure(self, inputs: Sequence[Path], report: Report | None) -> RunResult:
        if self.journal.damaged:
            damaged = f"{self.journal.damaged} records of the journal are damaged"
            self.notes.append(f"{self.out.path}: {damaged}; their captures are measured again")
        site = self._site()
        hashes = StageHashes(self.options)
        listed = list_captures(
            distinct(inputs, self.notes.append), self.options.reading, self.batch.opener
        )
        tasks = self._tasks(each_once(listed, self.notes.append), hashes)
        batch = Batch(tasks, self.options, self.out, self.batch.stop)
        for outcome in self.batch.engine(batch):
            done = self._take(outcome)
            if report is not None:
                report(done)
        with Boundary(self.failures, str(self.out.path)):
            self.journal.flush()
        with Boundary(self.failures, self.options.instances):
            self._note_instances()
        self.notes += self.summary.doubts()
        about = provenance_of(self.options, self.summary.models, site, self.started)
        self.failures += write_reports(
            self.out,
            self._records,
            self.summary,
            self.failures,
            about,
            parquet=self.batch.parquet,
        )
        return RunResult(
            self.failures,
            self.summary,
            self.before,
            self.notes,
            self.taken < self.listed,
            self.out.path,
            self._records,
        )

    def _site(self) -> Any:
        if self.options.calibration is None:
            return None
        from cucumbervision.calibration.calibration_file import read_site_calibration

        return read_site_calibration(self.options.calibration)

    def _tasks(
        self, listed: Iterable[Listed | Failure], hashes: StageHashes
    ) -> Iterator[Task | Outcome]:
        for one in listed:
            self.listed += 1
            if isinstance(one, Failure):
                yield Outcome(one.input, failures=(one,))
                continue
            task = Task(one)
            known = self.journal.find(task.place)
            if known is not None and not (
                known.picture and hashes.still_hold(known.stages, known.digest)
            ):
                known = None
            if known is not None:
                task = replace(task, known=known.content, trusted=self.batch.stop())
            if known is not None or not self.batch.stop():
                yield task

    def _take(self, outcome: Outcome) -> Outcome:
        """Journal what was measured, count it, and note what went wrong."""
        self.taken += 1
        record, failures = outcome.record, list(outcome.failures)
        if outcome.before:
            record = self.journal.find(outcome.place)
            failures += record.failures if record is not None else ()
            self.before += 1
        elif record is not None:
            before = len(failures)
            with Boundary(failures, outcome.input, outcome.name):
                self.journal.append(record)
            record = record if len(failures) == before else None
        if record is not None:
            self.summary.add(record.rows, record.models)
            self.order.append(bytes.fromhex(record.place))
            capture = record.capture
            names = (str(capture["name"]), str(capture.get("source") or ""))
            self.seen.append((names, capture.get("frame")))
        self.failures += failures
        return replace(outcome, record=record, failures=tuple(failures))

    def _note_instances(self) -> None:
        """Note which captures and which pictures of a file of instances have no counterpart."""
        path = Path(self.options.instances)
        if self.options.instances in INSTANCE_SOURCES or path.suffix.lower() == ".onnx":
            return
        missing, unused = read_instances(path).coverage(self.seen)
        if missing and len(missing) == len(self.seen):
            raise InstancesError(
                f"names none of the captures ({_some(missing)}); it names {_some(unused)}",
                source=path,
                remedy="name its pictures as the captures are called",
            )
        if missing:
            self.notes.append(f"{path}: no fruit given for {_some(missing)}")
        if unused and self.seen:
            self.notes.append(f"{path}: no capture is called {_some(unused)}")

    def _records(self) -> Iterator[JournalRecord]:
        return self.journal.records(place.hex() for place in self.order)


def _some(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"
