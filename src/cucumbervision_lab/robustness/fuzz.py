"""Broken files by the million: each is read by a limited process, and only named errors pass."""

from __future__ import annotations

import faulthandler
import gc
import multiprocessing
import os
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, cast

from cucumbervision.errors import CucumberVisionError, InternalError, OutOfMemoryError
from cucumbervision_lab.robustness.mutations import damaged
from cucumbervision_lab.robustness.seed_folder import SeedFolder
from cucumbervision_lab.robustness.targets import TARGETS, Target

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from multiprocessing.connection import Connection

_CRASH = "crash.txt"  # where the process was when a signal ended it
_KEPT = 3  # inputs kept of each place
_BATCH = 500  # inputs between two reports of a worker
_PATIENCE = 6.0  # times the limit, by the clock: a busy machine gives a process its turn late
_PACKAGES = ("cucumbervision/", "cucumbervision_lab/")


@dataclass(frozen=True)
class Limits:
    """What one input may use.

    Parameters
    ----------
    memory_bytes : int
        Memory of the process, with what it needs before the first input.
    seconds : float
        Computing time for one input.
    """

    memory_bytes: int = 2 * 1024**3
    seconds: float = 10.0


@dataclass(frozen=True)
class Find:
    """One input that did something other than work or raise a named error.

    Parameters
    ----------
    target : str
        Which reader.
    number : int
        The input: with the run's seed it can be made again.
    kind : str
        'unnamed', 'memory', 'time' or 'crash'.
    place : str
        The last line of our own code that was running, and the error's class.
    detail : str
        The traceback, or how the process ended.
    """

    target: str
    number: int
    kind: str
    place: str
    detail: str


@dataclass
class FuzzResult:
    """What a run did.

    Parameters
    ----------
    seed : int
        Of the run.
    tried, refused : Counter of str
        Inputs by target, none where it had no turn, and how many were refused with a named error.
    finds : dict of str to list of Find
        By place; the first few of each.
    found : Counter of str
        How often each place was found.
    seconds : float
        Time taken.
    """

    seed: int
    tried: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    finds: dict[str, list[Find]] = field(default_factory=dict)
    found: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0

    def note(self, find: Find) -> bool:
        """Count a find; tell whether it is one of the first of its place."""
        key = f"{find.target}: {find.kind} at {find.place}"
        self.found[key] += 1
        kept = self.finds.setdefault(key, [])
        if len(kept) < _KEPT:
            kept.append(find)
            return True
        return False


class _TooLongError(BaseException):
    """Not an Exception: no reader may take it for a fault of the file."""


def find_targets(names: Sequence[str]) -> tuple[Target, ...]:
    """Return the targets whose names begin with any of the given; all without one.

    Examples
    --------
    >>> [target.name for target in find_targets(["truth", "poses"])]
    ['truth tables', 'poses']
    """
    found = [d for d in TARGETS if not names or d.name.lower().startswith(tuple(names))]
    if not found:
        known = ", ".join(target.name for target in TARGETS)
        raise CucumberVisionError(f"no reader is called {', '.join(names)}", remedy=f"take {known}")
    return tuple(found)


def fuzz(
    inputs: int,
    seed: int = 1,
    targets: Sequence[Target] = TARGETS,
    out: Path | None = None,
    *,
    limits: Limits | None = None,
    seconds: float | None = None,
    tick: Callable[[int], None] | None = None,
) -> FuzzResult:
    """Read damaged files of every kind.

    Parameters
    ----------
    inputs : int
        How many.
    seed : int
        The same seed damages alike.
    targets : sequence of Target
        Which readers, in the shares of their weights.
    out : Path, optional
        Where finds are kept: `PLACE/NUMBER/` with the files and `traceback.txt`.
    limits : Limits, optional
        Of each input.
    seconds : float, optional
        Begin no further batch after this time.
    tick : callable, optional
        Called with how many more were tried.

    Returns
    -------
    FuzzResult
    """
    result, limits, began = FuzzResult(seed), limits or Limits(), time.monotonic()
    result.tried.update({target.name: 0 for target in targets})
    with _workplace(targets) as (place, folders):
        done = 0
        while done < inputs:
            if seconds is not None and time.monotonic() - began > seconds:
                break
            worker = _Worker(place, folders, targets, seed, (done, inputs), limits)
            try:
                done = worker.follow(result, out, tick, _until(began, seconds))
            finally:
                worker.end()
                for one in folders.values():  # one that ended by itself left a damaged file behind
                    one.restore(everything=True)
    result.seconds = time.monotonic() - began
    return result


def _until(began: float, seconds: float | None) -> float:
    return float("inf") if seconds is None else began + seconds


@contextmanager
def _workplace(targets: Sequence[Target]) -> Iterator[tuple[Path, dict[str, SeedFolder]]]:
    """Write every target's seeds into a folder, in memory where the system has one there."""
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and shutil.disk_usage(memory).free > 256 * 1024**2
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory if roomy else None) as tmp:
        folders = {}
        for target in targets:
            folder = Path(tmp) / target.name
            folder.mkdir()
            target.seed(folder)
            folders[target.name] = SeedFolder.of(folder)
        (Path(tmp) / _CRASH).touch()
        yield Path(tmp), folders


class _Worker:
    """A process that reads inputs until it is done or one of them ends it."""

    def __init__(
        self,
        place: Path,
        folders: Mapping[str, SeedFolder],
        targets: Sequence[Target],
        seed: int,
        span: tuple[int, int],
        limits: Limits,
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._at = context.Value("q", -1, lock=False)
        self._here, there = context.Pipe()
        self._limits, self._seed, self._stop = limits, seed, span[1]
        self._targets, self._place, self._folders = targets, place, folders
        given = (there, self._at, str(place), list(folders.values()), seed, span, limits)
        self._process = context.Process(target=_work, args=given, daemon=True)
        self._process.start()
        there.close()

    def follow(
        self,
        result: FuzzResult,
        out: Path | None,
        tick: Callable[[int], None] | None,
        until: float,
    ) -> int:
        """Take what the process reports; return the number of the next input."""
        before, since = -2, time.monotonic()
        while True:
            # Asked before the pipe is emptied: what a process says before it ends is in it by then.
            alive = self._process.is_alive()
            with suppress(EOFError, ConnectionResetError):
                while self._here.poll(1.0):
                    message = self._here.recv()
                    if isinstance(message, Find):
                        if result.note(message) and out is not None:
                            self._keep(message, out)
                        continue
                    tried, refused, done = message
                    result.tried.update(tried)
                    result.refused.update(refused)
                    if tick is not None:
                        tick(sum(tried.values()))
                    if done >= self._stop or time.monotonic() > until:
                        return int(done) if done < self._stop else self._stop
            at = int(self._at.value)
            if at != before:
                before, since = at, time.monotonic()
            stuck = at >= 0 and time.monotonic() - since > self._limits.seconds * _PATIENCE
            if stuck:
                self._process.kill()
                self._process.join()
            if stuck or not alive:
                return self._ended(result, out, at, stuck=stuck)

    def _ended(self, result: FuzzResult, out: Path | None, at: int, *, stuck: bool) -> int:
        crashed = (self._place / _CRASH).read_text(encoding="utf-8", errors="replace")
        if at < 0:
            raise CucumberVisionError(
                f"the reading process did not start (exit {self._process.exitcode}) {crashed}",
                remedy="give it more memory",
            )
        target = _target_of(self._targets, self._seed, at)
        code = self._process.exitcode
        kind, how = ("time", "no end") if stuck else ("crash", f"exit {code}")
        find = Find(target.name, at, kind, how, f"the process ended: {how}\n{crashed}")
        if result.note(find) and out is not None:
            self._keep(find, out)
        result.tried[target.name] += 1
        return at + 1

    def _keep(self, find: Find, out: Path) -> None:
        words = "".join(
            c if c.isalnum() else "-" for c in f"{find.target} {find.kind} {find.place}"
        )
        folder = out / words[:150] / str(find.number)
        shutil.rmtree(folder, ignore_errors=True)
        copy = replace(self._folders[find.target], root=str(folder))
        copy.restore(everything=True)
        _damage(copy, self._seed, find.number)
        (folder / "traceback.txt").write_text(find.detail, encoding="utf-8")

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._here.close()


def _target_of(targets: Sequence[Target], seed: int, number: int) -> Target:
    return Random(f"{seed}/{number}").choices(targets, [d.weight for d in targets])[0]


def replay(number: int, seed: int, folder: Path, targets: Sequence[Target] = TARGETS) -> Target:
    """Write one input of a run into a folder, which must not exist; return its target."""
    target = _target_of(targets, seed, number)
    folder.mkdir(parents=True)
    target.seed(folder)
    _damage(SeedFolder.of(folder), seed, number)
    return target


def _damage(folder: SeedFolder, seed: int, number: int) -> str:
    """Damage one file of a folder; return its name there."""
    random = Random(f"{seed}/{number}/damage")
    names = list(folder.files)
    name = random.choice(names)
    file = Path(folder.root, name)
    how = random.random()
    if how < 0.01:
        file.unlink()
    elif how < 0.02:
        file.unlink()
        file.mkdir()
    elif how < 0.03:
        file.rename(file.with_name("0" * random.choice((1, 200)) + "²3_" + file.name[-20:]))
    elif how < 0.05:
        file.write_bytes(folder.files[random.choice(names)])
    else:
        file.write_bytes(damaged(folder.files[name], file.suffix.lstrip("."), random))
    return name


def _work(
    report: Connection,
    at: Any,
    place: str,
    folders: Sequence[SeedFolder],
    seed: int,
    span: tuple[int, int],
    limits: Limits,
) -> None:
    known = {target.name: target for target in TARGETS}
    targets = [known[Path(folder.root).name] for folder in folders]
    of = dict(zip(targets, folders, strict=True))
    signal.signal(signal.SIGPROF, _ring)
    faulthandler.enable((Path(place) / _CRASH).open("w"), all_threads=False)
    _silence()
    warnings.simplefilter("ignore")
    _warm_up(of)
    _limit_memory(limits.memory_bytes)
    gc.freeze()  # what is loaded by now stays: it need not be looked through again and again
    tried: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    for number in range(*span):
        at.value = number
        target = _target_of(targets, seed, number)
        tried[target.name] += 1
        find = _one(target, of[target], seed, number, limits, refused)
        if find is not None:
            report.send(find)
        if sum(tried.values()) >= _BATCH or number + 1 == span[1]:
            report.send((tried, refused, number + 1))
            tried, refused = Counter(), Counter()


def _silence() -> None:
    """Send what libraries print, from C too, to nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):
        os.dup2(nowhere, number)


def _limit_memory(most: int) -> None:
    """Limit the process to `most` bytes: libraries that are mapped but not loaded do not count."""
    mapped, loaded = (
        int(n) * resource.getpagesize() for n in Path("/proc/self/statm").read_text().split()[:2]
    )
    limit = mapped - loaded + most
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _warm_up(folders: Mapping[Target, SeedFolder]) -> None:
    """Read every seed once: all is imported before memory is limited, and seeds are valid."""
    for target, folder in folders.items():
        try:
            target.read(Path(folder.root), "")
        except CucumberVisionError:
            if target.whole:
                raise
        folder.restore()


def _one(
    target: Target,
    folder: SeedFolder,
    seed: int,
    number: int,
    limits: Limits,
    refused: Counter[str],
) -> Find | None:
    name = _damage(folder, seed, number)
    kind, error = "", cast("BaseException | None", None)
    try:
        signal.setitimer(signal.ITIMER_PROF, limits.seconds)
        try:
            target.read(Path(folder.root), name)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
    except _TooLongError as caught:
        kind, error = "time", caught
    except (MemoryError, OutOfMemoryError) as caught:
        kind, error = "memory", caught
    except InternalError as caught:
        kind, error = "unnamed", caught
    except CucumberVisionError:
        refused[target.name] += 1
    except BaseException as caught:
        kind, error = "unnamed", caught
    folder.restore(name)
    if error is None:
        return None
    detail = "".join(traceback.format_exception(error))
    return Find(target.name, number, kind, _place_of(error), detail[-20_000:])


def _place_of(error: BaseException) -> str:
    # An error that was made of another is where that one was.
    while error.__cause__ is not None:
        error = error.__cause__
    name = type(error).__name__
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = frame.filename.replace(os.sep, "/")
        if "/robustness/" not in path and any(f"/{p}" in path for p in _PACKAGES):
            return f"{path.rpartition('/cucumbervision')[2].lstrip('/')}:{frame.lineno} {name}"
    return name


def _ring(*_: object) -> None:
    raise _TooLongError
