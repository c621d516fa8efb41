"""Read damaged files of every kind; only named errors may result.

    python -m tests.robustness.fuzz 100000 --seed 7 --out finds [--readers poses ...]

Each input is a valid file with one to three faults, read in a process that may hold 2 GB and
compute for 10 s on it. A finding is an error that is not ours, too much memory or time, or the end
of the process; the exit code is then 1.
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from rich.progress import track
from tests.robustness.mutations import damaged
from tests.robustness.targets import TARGETS, Target

from cucumbervision.errors import CucumberVisionError, InternalError, OutOfMemoryError

_BATCH = 200  # inputs per call of the reading process
_START = "spawn"  # of the reading process
_PACKAGES = ("cucumbervision/", "cucumbervision_lab/")


@dataclass(frozen=True)
class Limits:
    """What one input may use: memory of the process above its start, computing and clock time."""

    memory_bytes: int = 2 * 1024**3
    cpu_s: float = 10.0
    clock_s: float = 60.0


@dataclass(frozen=True)
class Finding:
    """An input that raised no named error, or broke a limit.

    Parameters
    ----------
    reader : str
        Name of the target.
    number : int
        The input: with the seed it can be made again.
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
    """Inputs tried and refused with a named error, by reader; and the findings."""

    tried: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)

    def add(self, other: Counts) -> None:
        """Add another batch."""
        self.tried.update(other.tried)
        self.refused.update(other.refused)
        self.findings += other.findings


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


def make_input(number: int, seed: int, folder: Path, targets: Sequence[Target] = TARGETS) -> Target:
    """Write an input into a new folder, and return its reader."""
    target = target_of(number, seed, targets)
    folder.mkdir(parents=True)
    target.seed(folder)
    damage(folder, number, seed)
    return target


class _TooLongError(BaseException):
    """Raised inside a reader that computes for too long; no `except Exception` catches it."""


def _stop(*_: object) -> None:
    raise _TooLongError


def read_input(
    target: Target, seeds: Path, number: int, seed: int, limits: Limits | None = None
) -> tuple[Finding | None, bool]:
    """Read one damaged copy of a reader's valid files.

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
    with tempfile.TemporaryDirectory(dir=seeds.parent) as tmp:
        folder = Path(tmp) / "input"
        shutil.copytree(seeds, folder)
        name = damage(folder, number, seed)
        faulthandler.dump_traceback_later(limits.clock_s, exit=True)
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
            faulthandler.cancel_dump_traceback_later()
    if caught is None:
        return None, False
    detail = "".join(traceback.format_exception(caught))[-20_000:]
    return Finding(target.name, number, kind, _place_of(caught), detail), False


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
    for number in numbers:
        target = target_of(number, job.seed, job.targets)
        finding, refused = read_input(target, job.place / target.name, number, job.seed, job.limits)
        counts.tried[target.name] += 1
        counts.refused[target.name] += refused
        counts.findings += [finding] if finding else []
    return counts


class _Reader:
    """A process that reads batches, replaced when an input ends it."""

    def __init__(self, job: _Job) -> None:
        self._job = job
        self._pool = self._new()

    def _new(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context(_START)
        return ProcessPoolExecutor(1, context, _begin, (self._job,))

    def read(self, numbers: range) -> Counts:
        """Read inputs; one that ends the process is found by halving the batch."""
        try:
            return self._pool.submit(_read_batch, numbers).result()
        except BrokenProcessPool:
            self._pool.shutdown()
            self._pool = self._new()
        if len(numbers) > 1:
            half, counts = len(numbers) // 2, self.read(numbers[: len(numbers) // 2])
            counts.add(self.read(numbers[half:]))
            return counts
        target = target_of(numbers[0], self._job.seed, self._job.targets)
        crash = Finding(target.name, numbers[0], "crash", "the process ended", "")
        return Counts(Counter({target.name: 1}), Counter(), [crash])

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
    limits: Limits | None = None,
) -> Counts:
    """Read damaged files and count what happens.

    Parameters
    ----------
    inputs : int
        How many.
    seed : int
        The same seed makes the same inputs.
    targets : sequence of Target
        Readers, drawn by weight.
    out : Path, optional
        Folder that gets the input and the traceback of the first finding of each kind.
    limits : Limits, optional
        Of each input.
    """
    counts, kept = Counts(), set[str]()
    with _valid_files(targets) as place:
        names = tuple(one.name for one in targets)
        reader = _Reader(_Job(place, seed, names, limits or Limits()))
        try:
            starts = range(0, inputs, _BATCH)
            for start in track(starts, "reading damaged files", disable=not sys.stderr.isatty()):
                batch = reader.read(range(start, min(start + _BATCH, inputs)))
                counts.add(batch)
                for one in batch.findings:
                    if out is not None and one.key not in kept:
                        kept.add(one.key)
                        folder = out / f"{one.reader.replace(' ', '-')}-{one.number}"
                        make_input(one.number, seed, folder, targets)
                        (folder / "traceback.txt").write_text(one.detail, encoding="utf-8")
        finally:
            reader.close()
    return counts


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
    given = parser.parse_args()
    counts = fuzz(given.inputs, given.seed, find_targets(given.readers), given.out)
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
