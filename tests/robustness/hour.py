"""Whether a stream stays as it began: an hour of `cucumbervision stream`, looked at every minute.

    python -m tests.robustness.hour [--minutes 60] [--every 4] [--instances dataset] [--counts FILE]

A program writes a capture every few seconds into a folder that the stream follows, in which fruit
pass by; it removes old ones, and every fortieth has a depth picture cut in half. Each minute the
process's memory, open files, threads, processor time, and the delay of its lines are printed, with
the minutes left. Ctrl-C or signal 15 ends it early, and it judges what it saw. The exit code is 1
if its memory grows by more than 2 % from the third quarter of the looks to the last, or by 20 %
after ten minutes; if files or threads grow at all; or if a capture has neither line nor failure.
Memory that the allocator keeps after the first captures is no leak: a leak goes on.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
from tests.robustness.counted import write_counts
from tests.robustness.trial import ALONE, begin

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision.capture.frames import Capture

STREAM = ("--follow", "--every", "--fast", "--quiet", "--instances")
_GROWTH = 0.02  # of the memory, from the third quarter to the last: 15 kB a capture in an hour
_WARM_GROWTH = 0.2  # after the first looks
_WARM = 10  # looks, until every network, cache and thread is there
_HELD = 200  # captures in the folder
_DAMAGED = 40
_MOVED_PX = 24  # from one capture to the next
_MINUTE_S = 60.0


@dataclass(frozen=True)
class Look:
    """A process at one moment, and its lines since the look before.

    Parameters
    ----------
    memory_mb, files, threads, busy_s : number
        Resident memory, open files, threads and processor time.
    latency_s : list of float
        Of each line.
    tracks : int
        The highest number of a fruit so far.
    """

    memory_mb: float
    files: int
    threads: int
    busy_s: float
    latency_s: list[float] = field(default_factory=list)
    tracks: int = 0

    def __str__(self) -> str:
        late = f"{median(self.latency_s):6.2f} {max(self.latency_s):6.2f}" if self.latency_s else ""
        counts = f"{self.files:5} {self.threads:7} {self.busy_s:8.1f} {len(self.latency_s):5}"
        return f"{self.memory_mb:9.1f} {counts} {self.tracks:6} {late}"


HEAD = "minute left memory_mb files threads processor_s lines tracks latency_s (median, most)"


def look_at(pid: int) -> dict[str, Any]:
    """Return memory, open files, threads and processor time of a process."""
    process = Path(f"/proc/{pid}")
    status = dict(
        line.split(":", 1) for line in (process / "status").read_text().splitlines() if ":" in line
    )
    ticks = (process / "stat").read_text().rpartition(")")[2].split()[11:13]
    return {
        "memory_mb": int(status["VmRSS"].split()[0]) / 1024,
        "threads": int(status["Threads"]),
        "files": len(list((process / "fd").iterdir())),
        "busy_s": sum(map(int, ticks)) / 100,
    }


def faults_of(looks: list[Look], warm: int = _WARM) -> list[str]:
    """Return what did not stay as it was after the first looks."""
    if len(looks) <= warm + 1:
        return ["too few looks"]
    first, last = looks[warm], looks[-1]
    quarter = (len(looks) + 3) // 4
    parts = looks[warm : warm + quarter], looks[-2 * quarter : -quarter], looks[-quarter:]
    warmed, before, after = (median(one.memory_mb for one in part) for part in parts)
    grows = after > before * (1 + _GROWTH) or after > warmed * (1 + _WARM_GROWTH)
    faults = [f"memory {warmed:.0f} to {before:.0f} to {after:.0f} MB"] if grows else []
    for name in ("files", "threads"):
        if getattr(last, name) > getattr(first, name):
            faults.append(f"{name} {getattr(first, name)} to {getattr(last, name)}")
    return faults


class Walk(threading.Thread):
    """Writes a capture every few seconds until it is stopped; fruit pass through its pictures."""

    def __init__(self, folder: Path, every_s: float, is_said: Callable[[str], bool]) -> None:
        super().__init__(name="walk", daemon=True)
        self._folder, self._every_s, self._is_said = folder, every_s, is_said
        self._one = next(iter(open_source(example_captures() / "simulated-row-a"))).load()
        self.ended = threading.Event()
        self.written: list[str] = []

    def run(self) -> None:
        """Write, each at its time."""
        begun_s = time.monotonic()
        for number in count():
            if self.ended.wait(max(begun_s + number * self._every_s - time.monotonic(), 0)):
                return
            aside = self._folder.parent / f"walk-{number:06d}"
            write_native(self._turned(number), aside)
            if number % _DAMAGED == _DAMAGED - 1:
                picture = next(aside.glob("depth*.png"))
                picture.write_bytes(picture.read_bytes()[: picture.stat().st_size // 2])
            aside.rename(self._folder / aside.name)
            self.written.append(aside.name)
            old = self._folder / f"walk-{number - _HELD:06d}"
            if self._is_said(old.name):  # a slow machine may not have come to it
                shutil.rmtree(old, ignore_errors=True)

    def _turned(self, number: int) -> Capture:
        one, by_px = self._one, -_MOVED_PX * number
        turned: dict[str, Any] = {
            "color": np.roll(one.color, by_px, 1),
            "depth_m": np.roll(one.depth_m, by_px, 1),
            "masks": tuple(np.roll(mask, by_px, 1) for mask in one.masks),
            "timestamp_s": 1.79e9 + number / 15,  # as a camera takes them, however slowly they come
        }
        return replace(one, frame=number, name=f"walk-{number:06d}", **turned)


@dataclass
class Stream:
    """A stream that follows a folder, and what it said so far."""

    process: subprocess.Popen[str]
    lines: list[dict[str, Any]] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._taken = 0
        self._hearing = threading.Thread(target=self._hear, name="lines")
        self._hearing.start()

    def _hear(self) -> None:
        output: Any = self.process.stdout
        for line in output:
            if line.startswith("{"):
                self.lines.append(json.loads(line))
            else:
                self.failures.append(line)
        output.close()

    def look(self) -> Look:
        """Look at the process, and at its lines since the last look."""
        fresh, self._taken = self.lines[self._taken :], len(self.lines)
        earlier = self.looks[-1].tracks if self.looks else 0
        tracks = max([earlier, *(one["track"] for line in fresh for one in line["fruit"])])
        late = [line["latency_s"] for line in fresh]
        self.looks.append(Look(**look_at(self.process.pid), latency_s=late, tracks=tracks))
        return self.looks[-1]

    def end(self) -> None:
        """Ask the process to end, make it end, and hear what it said last."""
        self._catch_up()
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(60)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._hearing.join()

    def _catch_up(self) -> None:
        """Wait while lines come: what was written last is measured, too."""
        said = -1
        while self.process.poll() is None and said < (said := len(self.lines)):
            sys.stdout.write(f"{said} lines so far; waiting for what was written last\n")
            sys.stdout.flush()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(_MINUTE_S)

    def says(self, name: str) -> bool:
        """Return whether a capture has a line or a failure."""
        measured = any(line["capture"] == name for line in reversed(self.lines))
        return measured or any(name in line for line in self.failures)

    def unsaid(self, walk: Walk) -> list[str]:
        """Return the captures that have neither a line nor a failure."""
        # Captures before the first line were there before the stream was open.
        first = self.lines[0]["capture"] if self.lines else ""
        return [name for name in walk.written if name > first and not self.says(name)]


def stream_for(
    folder: Path,
    minutes: int,
    every_s: float,
    instances: str = "models",
    ended: threading.Event | None = None,
) -> tuple[list[str], dict[str, Any]]:
    """Run a stream and print a look at every minute, until its time is over or `ended` is set.

    Returns
    -------
    list of str
        What is wrong.
    dict
        Its counts.
    """
    house = folder / "house"
    house.mkdir()
    ended = ended or threading.Event()
    stream = Stream(begin("stream", house, *STREAM, instances, before=ALONE))
    walk = Walk(house, every_s, stream.says)
    walk.start()
    died = []
    try:
        while not stream.lines and stream.process.poll() is None and not ended.wait(every_s):
            pass
        sys.stdout.write(f"{HEAD}\n")
        for minute in range(1, minutes + 1):
            if ended.wait(_MINUTE_S):
                break
            if stream.process.poll() is not None:
                died = [f"the stream ended with {stream.process.returncode}"]
                break
            sys.stdout.write(f"{minute:6} {minutes - minute:4} {stream.look()}\n")
            sys.stdout.flush()
    finally:
        walk.ended.set()
        walk.join()
        stream.end()
    if died:
        return [*died, *stream.failures[-3:]], counts_of(stream)
    unsaid = [f"nothing is said of {name}" for name in stream.unsaid(walk)]
    return faults_of(stream.looks) + unsaid, counts_of(stream)


def counts_of(stream: Stream) -> dict[str, Any]:
    """Return how much a stream was given, and how its process was after the warm-up and at last."""
    came = f"{len(stream.lines):,} measured, {len(stream.failures):,} refused by name"
    if len(stream.looks) > _WARM:
        first, last = stream.looks[_WARM], stream.looks[-1]
        changes = [
            f"{getattr(first, name):.0f} and {getattr(last, name):.0f} {unit}"
            for name, unit in (("memory_mb", "MB"), ("files", "files"), ("threads", "threads"))
        ]
        came += f"; {', '.join(changes)} after {_WARM + 1} and {len(stream.looks)} minutes"
    return {"inputs": len(stream.lines) + len(stream.failures), "came": came}


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--every", type=float, default=4, help="seconds from capture to capture")
    parser.add_argument("--instances", default="models", help="as of `stream`")
    parser.add_argument("--counts", type=Path, help="file to which the counts are written")
    given = parser.parse_args()
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    with tempfile.TemporaryDirectory(prefix="stream-") as tmp:
        faults, counts = stream_for(Path(tmp), given.minutes, given.every, given.instances, ended)
    verdict = f"{len(faults)} faults" if faults else "as it began"
    counts["came"] += f": {verdict}"
    if given.counts is not None:
        write_counts(given.counts, "hour", counts)
    sys.stdout.write("".join(f"{fault}\n" for fault in faults))
    sys.stdout.write(f"{counts['inputs']:,} captures: {counts['came']}\n")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
