"""Whether a stream stays as it began: an hour of `cucumbervision stream`, looked at every minute.

    python -m tests.robustness.hour [--minutes 60] [--every 4] [--instances dataset]

A program writes a capture every few seconds into a folder that the stream follows, in which fruit
pass by; it removes old ones, and every fortieth has a depth picture cut in half. Each minute the
process's memory, open files, threads, processor time, and the delay of its lines are printed. The
exit code is 1 if its memory grows by more than 2 % from the third quarter of the looks to the last,
or by 20 % after ten minutes; if files or threads grow at all; or if a capture has neither line nor
failure. Memory that the allocator keeps after the first captures is no leak: a leak goes on.
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
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
from tests.robustness.trial import begin

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture

STREAM = ("--follow", "--every", "--fast", "--quiet", "--instances")
_GROWTH = 0.02  # of the memory, from the third quarter to the last: 15 kB a capture in an hour
_WARM_GROWTH = 0.2  # after the first looks
_WARM = 10  # looks, until every network, cache and thread is there
_HELD = 200  # captures in the folder
_DAMAGED = 40
_MOVED_PX = 24  # from one capture to the next


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


HEAD = "minute memory_mb files threads processor_s lines tracks latency_s (median, most)"


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

    def __init__(self, folder: Path, every_s: float) -> None:
        super().__init__(name="walk", daemon=True)
        self._folder, self._every_s = folder, every_s
        self._one = next(iter(open_source(example_captures() / "simulated-row-a"))).load()
        self.ended = threading.Event()
        self.whole: list[str] = []
        self.damaged: list[str] = []

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
                self.damaged.append(aside.name)
            else:
                self.whole.append(aside.name)
            aside.rename(self._folder / aside.name)
            shutil.rmtree(self._folder / f"walk-{number - _HELD:06d}", ignore_errors=True)

    def _turned(self, number: int) -> Capture:
        one, by_px = self._one, -_MOVED_PX * number
        turned: dict[str, Any] = {
            "color": np.roll(one.color, by_px, 1),
            "depth_m": np.roll(one.depth_m, by_px, 1),
            "masks": tuple(np.roll(mask, by_px, 1) for mask in one.masks),
            "timestamp_s": 1.79e9 + number / 15,  # as a camera takes them, however slowly they come
        }
        return replace(one, frame=number, name=f"walk-{number:06d}", **turned)


def stream_for(
    folder: Path, minutes: float, every_s: float, instances: str = "models", minute_s: float = 60.0
) -> list[str]:
    """Run a stream, print a look at every minute, and return what is wrong."""
    house = folder / "house"
    house.mkdir()
    lines: list[dict[str, Any]] = []
    failures: list[str] = []
    process = begin("stream", house, *STREAM, instances)
    output: Any = process.stdout

    def hear() -> None:
        for line in output:
            if line.startswith("{"):
                lines.append(json.loads(line))
            else:
                failures.append(line)

    hearing = threading.Thread(target=hear, name="lines")
    hearing.start()
    walk = Walk(house, every_s)
    walk.start()
    looks: list[Look] = []
    taken = tracks = 0
    try:
        while not lines and process.poll() is None:
            time.sleep(every_s)
        sys.stdout.write(f"{HEAD}\n")
        for minute in range(1, round(minutes) + 1):
            time.sleep(minute_s)
            if process.poll() is not None:
                return [f"the stream ended with {process.returncode}: {failures[-3:]}"]
            fresh, taken = lines[taken:], len(lines)
            tracks = max([tracks, *(one["track"] for line in fresh for one in line["fruit"])])
            late = [line["latency_s"] for line in fresh]
            looks.append(Look(**look_at(process.pid), latency_s=late, tracks=tracks))
            sys.stdout.write(f"{minute:6} {looks[-1]}\n")
            sys.stdout.flush()
    finally:
        walk.ended.set()
        walk.join()
        time.sleep(min(10 * every_s, 60))  # what was written last is measured, too
        process.send_signal(signal.SIGINT)
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
        hearing.join()
    first = lines[0]["capture"]  # those before it were there before the stream was open
    whole = sorted(set(walk.whole) - {line["capture"] for line in lines})
    damaged = [name for name in walk.damaged if not any(name in line for line in failures)]
    sys.stdout.write(f"{len(lines)} lines, {len(failures)} failures\n")
    unsaid = [name for name in (*whole, *damaged) if name > first]
    return faults_of(looks) + [f"nothing is said of {name}" for name in unsaid]


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--every", type=float, default=4, help="seconds from capture to capture")
    parser.add_argument("--instances", default="models", help="as of `stream`")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="stream-") as tmp:
        faults = stream_for(Path(tmp), given.minutes, given.every, given.instances)
    sys.stdout.write("".join(f"{fault}\n" for fault in faults) or "as it began\n")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
