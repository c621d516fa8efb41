"""Read damaged files of every kind; only named errors may result.

    python -m tests.robustness.fuzz 100000 --seed 7 --out finds [--readers poses ...]
    python -m tests.robustness.fuzz 1000000 --by hypothesis --counts tests/robustness/counts.json

Each input is a valid file with one to three faults, which either `mutations` or Hypothesis chooses,
read in a process that may hold 1 GB and compute for 10 s on it. A finding is an error that is not
ours, too much memory or time, or the end of the process; the exit code is then 1. With a file of
counts a run goes on where the last one ended: it first reads what was found once more.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st
from rich.progress import track
from tests.robustness.counted import read_counts, write_counts
from tests.robustness.drawn import drawn_damage
from tests.robustness.mutations import damaged
from tests.robustness.targets import TARGETS, Target

from cucumbervision.errors import CucumberVisionError, InternalError, OutOfMemoryError

_BATCH = 200  # inputs per call of the reading process
_DRAWN_BATCH = 2000  # Hypothesis begins each reader of a batch with its simplest inputs
GENERATORS = ("mutations", "hypothesis")
_START = "spawn"  # of the reading process
_PACKAGES = ("cucumbervision/", "cucumbervision_greenhouse/", "cucumbervision_lab/")


@dataclass(frozen=True)
class Limits:
    """What one input may use: memory of the process above its start, computing and clock time."""

    memory_bytes: int = 1_000_000_000
    cpu_s: float = 10.0
    clock_s: float = 300.0  # on a machine that does much else


@dataclass(frozen=True)
class Finding:
    """An input that raised no named error, or broke a limit.

    Parameters
    ----------
    reader : str
        Name of the target.
    number : int
        The input: with the seed it can be made again. Of one that Hypothesis drew, its batch.
    kind : str
        'unnamed', 'memory', 'time' or 'crash'.
    place : str
        The last line of our own code in the traceback, and the error's class.
    detail : str
        The traceback.
    """

    reader: str
    number: int
    kind: str
    place: str
    detail: str

    @property
    def key(self) -> str:
        """What findings of one cause share."""
        return f"{self.reader}: {self.kind} at {self.place}"


@dataclass
class Counts:
    """Inputs tried and refused with a named error, by reader; and the findings.

    `numbers` is where a later run goes on, `mended` counts earlier findings that are none any more.
    """

    tried: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)
    numbers: int = 0
    seed: int = 1
    mended: Counter[str] = field(default_factory=Counter)

    def add(self, other: Counts) -> None:
        """Add another batch."""
        self.tried.update(other.tried)
        self.refused.update(other.refused)
        self.findings += other.findings

    @classmethod
    def load(cls, path: Path, run: str, seed: int) -> Counts:
        """Read the counts of earlier runs of a generator and some readers, or none."""
        found = read_counts(path).get(run)
        if found is None:
            return cls(seed=seed)
        findings = [Finding(detail="", **one) for one in found.pop("findings")]
        counters = {name: Counter(found.pop(name)) for name in ("tried", "refused", "mended")}
        return cls(findings=findings, **{**found, **counters})

    def save(self, path: Path, run: str) -> None:
        """Put the counts into a file, beside those of others."""
        rows = [asdict(one) for one in self.findings]
        rows = [{key: value for key, value in row.items() if key != "detail"} for row in rows]
        write_counts(path, run, {**vars(self), "findings": rows})


def damage_drawn(folder: Path, draw: Any) -> str:
    """Damage one file of a folder as Hypothesis draws it; return its path below the folder."""
    names = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    name: str = draw(st.sampled_from(names))
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(drawn_damage(data, name.rpartition(".")[2], draw))
    return name


def target_of(number: int, seed: int, targets: Sequence[Target] = TARGETS) -> Target:
    """Return the reader of an input, drawn by weight."""
    return Random(f"{seed}/{number}").choices(targets, [one.weight for one in targets])[0]


def damage(folder: Path, number: int, seed: int) -> str:
    """Damage one file of a folder of valid files; return its path below the folder."""
    random = Random(f"{seed}/{number}/damage")
    names = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    name = random.choice(names)
    file, how = folder / name, random.random()
    if how < 0.02:
        file.unlink()
        if how < 0.01:
            file.mkdir()
    elif how < 0.03:
        file.rename(file.with_name("0" * random.choice((1, 200)) + "²3_" + file.name[-20:]))
    elif how < 0.05:
        file.write_bytes((folder / random.choice(names)).read_bytes())
    else:
        file.write_bytes(damaged(file.read_bytes(), file.suffix.lstrip("."), random))
    return name


class _TooLongError(BaseException):
    """Raised inside a reader that computes for too long; no `except Exception` catches it."""


def _stop(*_: object) -> None:
    raise _TooLongError


def read_input(
    target: Target,
    seeds: Path,
    number: int,
    harm: Callable[[Path], str],
    limits: Limits | None = None,
    out: Path | None = None,
) -> tuple[Finding | None, bool]:
    """Read one damaged copy of a reader's valid files.

    Parameters
    ----------
    target : Target
        The reader.
    seeds : Path
        Its valid files.
    number : int
        Of the input, for what is found.
    harm : callable
        Damages one file of a folder and returns its path below the folder.
    limits : Limits, optional
        Of the input.
    out : Path, optional
        Gets the input and the traceback of a finding.

    Returns
    -------
    finding : Finding or None
        What went wrong.
    refused : bool
        Whether a named error was raised.
    """
    limits = limits or Limits()
    kind = ""
    caught: BaseException | None = None
    with tempfile.TemporaryDirectory(prefix="input-", dir=seeds.parent) as tmp:
        folder = Path(tmp) / "input"
        (Path(tmp) / "reader").write_text(target.name, "utf-8")
        shutil.copytree(seeds, folder)
        name = harm(folder)
        # The system ends a process that hangs; a thread that watched it would cost every input two
        # changes of thread.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, limits.clock_s)
        signal.signal(signal.SIGPROF, _stop)
        try:
            signal.setitimer(signal.ITIMER_PROF, limits.cpu_s)
            try:
                target.read(folder, name)
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
        except (MemoryError, OutOfMemoryError) as error:
            kind, caught = "memory", error
        except CucumberVisionError as error:
            if not isinstance(error, InternalError):
                return None, True
            kind, caught = "unnamed", error
        except BaseException as error:
            kind, caught = "time" if isinstance(error, _TooLongError) else "unnamed", error
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        if caught is None:
            return None, False
        detail = "".join(traceback.format_exception(caught))[-20_000:]
        found = Finding(target.name, number, kind, _place_of(caught), detail)
        if out is not None:
            _keep(folder, out, found)
    return found, False


def _keep(folder: Path, out: Path, found: Finding) -> None:
    """Copy an input that is the first of its kind, with its traceback."""
    place = out / re.sub(r"[^\w.:]+", "-", found.key)
    if not place.exists() and folder.exists():
        shutil.copytree(folder, place)
        (place / "traceback.txt").write_text(f"input {found.number}\n{found.detail}", "utf-8")


def _place_of(error: BaseException) -> str:
    while error.__cause__ is not None:  # an error made of another is where that one was
        error = error.__cause__
    name = type(error).__name__
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = frame.filename.replace(os.sep, "/")
        if "/robustness/" not in path and any(f"/{package}" in path for package in _PACKAGES):
            return f"{path.rpartition('/cucumbervision')[2].lstrip('/')}:{frame.lineno} {name}"
    return name


@dataclass(frozen=True)
class _Job:
    place: Path
    seed: int
    readers: tuple[str, ...]
    limits: Limits
    by: str
    out: Path | None

    @property
    def targets(self) -> tuple[Target, ...]:
        return tuple(one for one in TARGETS if one.name in self.readers)


_job: list[_Job] = []  # of the reading process


def _begin(job: _Job) -> None:
    """Prepare the reading process: load what readers import, then limit its memory."""
    _job.append(job)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    warnings.simplefilter("ignore")
    for target in job.targets:
        try:
            target.read(job.place / target.name, "")
        except CucumberVisionError:
            if target.whole:
                raise
    mapped, loaded = (
        int(pages) * resource.getpagesize()
        for pages in Path("/proc/self/statm").read_text().split()[:2]
    )
    most = mapped - loaded + job.limits.memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    gc.freeze()


def _read_batch(numbers: range) -> Counts:
    job, counts = _job[0], Counts()

    def read(target: Target, number: int, harm: Callable[[Path], str]) -> None:
        seeds = job.place / target.name
        finding, refused = read_input(target, seeds, number, harm, job.limits, job.out)
        counts.tried[target.name] += 1
        counts.refused[target.name] += refused
        counts.findings += [finding] if finding else []

    targets = [target_of(number, job.seed, job.targets) for number in numbers]
    if job.by == "mutations":
        for number, target in zip(numbers, targets, strict=True):
            read(target, number, partial(damage, number=number, seed=job.seed))
        return counts
    for target, inputs in Counter(targets).items():
        begin = f"{job.seed}/{numbers.start}/{target.name}"
        _draw_inputs(inputs, begin, partial(read, target, numbers.start))
    return counts


def _draw_inputs(inputs: int, begin: str, read: Callable[[Callable[[Path], str]], None]) -> None:
    """Let Hypothesis damage about so many files of one reader; the same begin draws the same."""

    @seeded(begin)
    @settings(
        max_examples=inputs,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def draw(data: st.DataObject) -> None:
        read(partial(damage_drawn, draw=data.draw))

    draw()


class _Reader:
    """A process that reads batches, replaced when an input ends it."""

    def __init__(self, job: _Job) -> None:
        self._job = job
        self._pool = self._new()

    def _new(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context(_START)
        return ProcessPoolExecutor(1, context, _begin, (self._job,))

    def read(self, numbers: range) -> Counts:
        """Read inputs; one that ends the process is found by halving the batch.

        What Hypothesis draws cannot be halved: the others of such a batch are not counted.
        """
        try:
            return self._pool.submit(_read_batch, numbers).result()
        except BrokenProcessPool:
            self._pool.shutdown()
            self._pool = self._new()
        if len(numbers) > 1 and self._job.by == "mutations":
            half, counts = len(numbers) // 2, self.read(numbers[: len(numbers) // 2])
            counts.add(self.read(numbers[half:]))
            return counts
        # What it was reading is still there.
        left = max(self._job.place.glob("input-*/input"), key=lambda p: p.stat().st_ctime)
        target = (left.parent / "reader").read_text(encoding="utf-8")
        crash = Finding(target, numbers[0], "crash", "the process ended", "")
        if self._job.out is not None:
            _keep(left, self._job.out, crash)
        shutil.rmtree(left.parent)
        return Counts(Counter({target: 1}), Counter(), [crash])

    def close(self) -> None:
        self._pool.shutdown()


@contextmanager
def _valid_files(targets: Sequence[Target]) -> Iterator[Path]:
    """Write every reader's valid files into a folder, in memory where the system has one."""
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and shutil.disk_usage(memory).free > 256 * 1024**2
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory if roomy else None) as tmp:
        for target in targets:
            (Path(tmp) / target.name).mkdir()
            target.seed(Path(tmp) / target.name)
        yield Path(tmp)


def fuzz(
    inputs: int,
    seed: int = 1,
    targets: Sequence[Target] = TARGETS,
    out: Path | None = None,
    *,
    by: str = "mutations",
    limits: Limits | None = None,
    counted: Path | None = None,
) -> Counts:
    """Read damaged files and count what happens.

    Parameters
    ----------
    inputs : int
        How many, those of earlier runs included.
    seed : int
        The same seed makes the same inputs.
    targets : sequence of Target
        Readers, drawn by weight.
    out : Path, optional
        Folder that gets the input and the traceback of the first finding of each kind.
    by : str
        Who damages: one of `GENERATORS`.
    limits : Limits, optional
        Of each input.
    counted : Path, optional
        File of counts, to which this run adds.
    """
    names = tuple(one.name for one in targets)
    run = by if len(names) == len(TARGETS) else f"{by}: {', '.join(names)}"
    counts = Counts.load(counted, run, seed) if counted else Counts(seed=seed)
    size = _BATCH if by == "mutations" else _DRAWN_BATCH
    with _valid_files(targets) as place:
        reader = _Reader(_Job(place, counts.seed, names, limits or Limits(), by, out))
        try:
            _read_again(counts, reader, 1 if by == "mutations" else size)
            if counted is not None:
                counts.save(counted, run)
            starts = range(counts.numbers, inputs, size)
            for start in track(starts, "reading damaged files", disable=not sys.stderr.isatty()):
                counts.numbers = min(start + size, inputs)
                counts.add(reader.read(range(start, counts.numbers)))
                if counted is not None:
                    counts.save(counted, run)
        finally:
            reader.close()
    return counts


def _read_again(counts: Counts, reader: _Reader, size: int) -> None:
    """Read what was found by earlier runs: what is no finding any more is mended."""
    before, counts.findings = counts.findings, []
    for number in sorted({one.number for one in before}):
        counts.findings += reader.read(range(number, number + size)).findings
    fewer = Counter(one.key for one in before) - Counter(one.key for one in counts.findings)
    counts.mended.update(fewer)


def find_targets(names: Sequence[str]) -> tuple[Target, ...]:
    """Return the readers whose names begin with one of these; all without a name."""
    found = [one for one in TARGETS if not names or one.name.lower().startswith(tuple(names))]
    if not found:
        raise CucumberVisionError(
            f"no reader is called {', '.join(names)}",
            remedy=f"use {', '.join(one.name for one in TARGETS)}",
        )
    return tuple(found)


def main() -> int:
    """Run from the command line, and print a table by reader."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("inputs", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--readers", nargs="*", default=())
    parser.add_argument("--by", choices=GENERATORS, default=GENERATORS[0])
    parser.add_argument("--counts", type=Path, help="file to which the counts are added")
    said = parser.parse_args()
    targets = find_targets(said.readers)
    counts = fuzz(said.inputs, said.seed, targets, said.out, by=said.by, counted=said.counts)
    of_reader = Counter(one.reader for one in counts.findings)
    for name, tried in sorted(counts.tried.items()):
        line = f"{name:28}{tried:9,}{counts.refused[name]:9,} refused{of_reader[name]:5} findings\n"
        sys.stdout.write(line)
    sys.stdout.write(
        f"{counts.tried.total():,} inputs, {counts.refused.total():,} refused by name, "
        f"{len(counts.findings)} findings\n"
    )
    for key, count in Counter(one.key for one in counts.findings).most_common():
        sys.stdout.write(f"{count} x {key}\n")
    return 1 if counts.findings else 0


if __name__ == "__main__":
    sys.exit(main())
