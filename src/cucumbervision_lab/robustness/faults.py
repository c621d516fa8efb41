"""Faults on purpose: what the user sees of each, and whether anything is lost."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING

from cucumbervision.capture.source import bundled_captures
from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

__all__ = ["FAULTS", "Outcome", "kill_rounds", "try_faults"]

_MASKS = ("--instances", "dataset", "--segmenter", "none", "--methods", "M1,M2")
# Root may write anywhere: without these two it may as little as any owner.
_BOUND = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
_TABLE = "measurements.csv"


@dataclass(frozen=True)
class Outcome:
    """What came of a fault.

    Parameters
    ----------
    fault : str
        What was done.
    seen : str
        What the user sees: the program's own line.
    kept : str
        What is there afterwards.
    lost : bool
        Whether something is lost, doubled or nameless that should not be.
    """

    fault: str
    seen: str
    kept: str
    lost: bool = False


@dataclass(frozen=True)
class _Ran:
    code: int
    said: str

    def line(self, word: str = "") -> str:
        """Return the last line with a word in it, without the folder of this trial."""
        lines = [" ".join(line.split()) for line in self.said.splitlines() if line.strip()]
        found = [line for line in lines if word in line] or lines or ["nothing"]
        return found[-1]


def _command(*words: object, before: str = "", bound: bool = False) -> _Ran:
    """Run the program as a user does; `before` runs first in its process."""
    code = f"{before}\nfrom cucumbervision.cli.app import main\nmain()"
    done = subprocess.run(
        [*(_BOUND if bound else ()), sys.executable, "-c", code, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "COLUMNS": "400", "PYTHONDONTWRITEBYTECODE": "1"},
    )
    return _Ran(done.returncode, done.stdout + done.stderr)


def _captures(folder: Path, count: int = 3) -> Path:
    """Write some captures, all of them different."""
    from cucumbervision.capture.readers import open_source
    from cucumbervision.capture.readers.native import write_native

    one = next(iter(open_source(bundled_captures() / "simulated-row-b"))).load()
    for k in range(count):
        depth_m = one.depth_m + (one.depth_m > 0) * 0.001 * k

        write_native(
            replace(one, depth_m=depth_m.astype("float32"), name=f"c{k}"), folder / f"c{k}"
        )
    return folder


def _rows(out: Path) -> list[list[str]]:
    """Return a run's rows without what tells one run from another."""
    with (out / _TABLE).open(encoding="utf-8-sig", newline="") as stream:
        return [list(row.values()) for row in csv.DictReader(stream)]


def _of(rows: Sequence[Sequence[str]], *captures: str) -> list[Sequence[str]]:
    return [row for row in rows if set(captures) & set(row)]


def _truncated(folder: Path) -> Outcome:
    return _damaged_picture(folder, "a depth picture is cut in half", lambda d: d[: len(d) // 2])


def _flipped(folder: Path) -> Outcome:
    def flip(data: bytes) -> bytes:
        return data[:500] + bytes([data[500] ^ 8]) + data[501:]

    return _damaged_picture(folder, "a bit of a depth picture is flipped", flip)


def _damaged_picture(folder: Path, fault: str, damage: Callable[[bytes], bytes]) -> Outcome:
    source = _captures(folder / "in")
    _command("measure", source, "--out", folder / "whole", *_MASKS)
    file = source / "c1" / "depth_000000.png"
    file.write_bytes(damage(file.read_bytes()))
    ran = _command("measure", source, "--out", folder / "out", *_MASKS)
    wanted = _of(_rows(folder / "whole"), "c0", "c2")
    lost = _rows(folder / "out") != wanted or ran.code != 1
    return Outcome(fault, ran.line("depth_000000"), "the rows of the two others", lost)


def _folder_gone(folder: Path) -> Outcome:
    source = _captures(folder / "in")
    _command("measure", source, "--out", folder / "whole", *_MASKS)
    # As soon as the first picture of the run is drawn, what is left to read goes.
    gone = (
        "import shutil\nfrom cucumbervision.pipeline.work import Worker\nadd = Worker._draw\n"
        f"gone = {str(source)!r}\n"
        "def once(self, result):\n    add(self, result)\n    shutil.rmtree(gone, True)\n"
        "Worker._draw = once"
    )
    ran = _command("measure", source, "--out", folder / "out", *_MASKS, before=gone)
    whole, rows = _rows(folder / "whole"), _rows(folder / "out")
    # The second one may have been read while the first was measured.
    lost = rows not in (_of(whole, "c0"), _of(whole, "c0", "c1")) or ran.code != 1
    return Outcome("the folder goes in mid-run", ran.line("c2"), "the rows of what was read", lost)


@contextmanager
def _small_disk(folder: Path, size: str) -> Iterator[str]:
    """Give a folder little room: a small file system of its own, where one can be mounted."""
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        raise CucumberVisionError("no small file system can be mounted here", remedy="run as root")
    try:
        yield str(folder)
    finally:
        subprocess.run(["umount", str(folder)], check=False)


def _disk_full(folder: Path) -> Outcome:
    source = _captures(folder / "in", 6)
    _command("measure", source, "--out", folder / "whole", *_MASKS)
    one = sum(p.stat().st_size for p in (folder / "whole" / "overlays").iterdir()) // 6
    with _small_disk(folder / "disk", f"{(3 * one) // 1024 + 64}k") as disk:
        ran = _command("measure", source, "--out", f"{disk}/out", *_MASKS)
        subprocess.run(["mount", "-o", "remount,size=64m", disk], check=True)
        again = _command("measure", source, "--out", f"{disk}/out", *_MASKS)
        rows = _rows(Path(disk) / "out")
    lost = rows != _rows(folder / "whole") or ran.code not in (1, 2) or again.code != 0
    kept = "the journal; with room again the same command goes on to all rows"
    return Outcome("the disk is full (tmpfs)", ran.line("No space"), kept, lost)


def _no_permission(folder: Path) -> Outcome:
    source, out = _captures(folder / "in"), folder / "out"
    out.mkdir(mode=0o555)
    ran = _command("measure", source, "--out", out / "new", *_MASKS, bound=os.getuid() == 0)
    lost = ran.code != 2 or any(out.iterdir())
    return Outcome("no permission to write", ran.line("cucumbervision:"), "nothing begun", lost)


def _unreadable_folder(folder: Path) -> Outcome:
    source, out = _captures(folder / "in", 2), folder / "out"
    (source / "c1").chmod(0)
    ran = _command("measure", source, "--out", out, *_MASKS, bound=os.getuid() == 0)
    (source / "c1").chmod(0o755)
    lost = ran.code != 1 or not _of(_rows(out), "c0") or "c1" not in ran.said
    return Outcome("a folder may not be read", ran.line("c1"), "the row of the other", lost)


def _postgres_gone(folder: Path) -> Outcome:
    from sqlalchemy import event

    from cucumbervision.store.repository import open_store
    from cucumbervision_lab.robustness.seeds import stop_of
    from cucumbervision_lab.robustness.throwaway_postgres import missing_reason, throwaway_cluster

    if reason := missing_reason():
        raise CucumberVisionError(reason)
    with throwaway_cluster() as cluster:
        url = cluster.new_database()
        with open_store(url, images=folder / "pictures") as store:
            walk, stop = stop_of(store)
            store.save_round(walk)
            asked = 0

            def before(*_: object) -> None:
                nonlocal asked
                asked += 1
                if asked == 6:  # the transaction has written, and has more to write
                    cluster.stop(at_once=True)

            event.listen(store.engine, "before_cursor_execute", before)
            try:
                store.save_stop(stop)
                seen = "nothing"
            except CucumberVisionError as error:
                seen = str(error)
            event.remove(store.engine, "before_cursor_execute", before)
            cluster.start()
            half = len(store.stops(walk.key))
            store.save_stop(stop)
            store.save_stop(stop)
            lost = half != 0 or store.stop(stop.key) != stop or len(store.stops(walk.key)) != 1
    kept = "no half stop; sent again it is there once"
    return Outcome("PostgreSQL is killed in a transaction", seen, kept, lost or seen == "nothing")


def _camera_gone(folder: Path) -> Outcome:
    from cucumbervision.capture.realsense import AlignedStream, play_file
    from cucumbervision_lab.robustness.seeds import recording

    recording(folder)
    # Taken for live, a recording paces itself by the clock and then sends nothing more.
    stream = AlignedStream(
        play_file(folder / "walk.db3"), source="camera 0042", playback=False, timeout_s=1.0
    )
    frames, seen = 0, "nothing"
    with stream:
        try:
            while True:
                stream.read()
                frames += 1
        except CucumberVisionError as error:
            seen = str(error)
    kept = f"{frames} frames were read before"
    return Outcome("the camera is unplugged in mid-burst", seen, kept, frames == 0)


def _clock_back(folder: Path) -> Outcome:
    source, store = _captures(folder / "in"), folder / "house.db"
    _command("round", "new", "walk", "--store", store)
    _command("round", "add", source / "c0", "--store", store, "--instances", "dataset")
    back = "import time\nnow = time.time\ntime.time = lambda: now() - 86400"
    add = ("round", "add", source, "--store", store, "--instances", "dataset")
    ran = _command(*add, before=back)
    lost = _stops(store) != ["c0", "c1", "c2"]
    return Outcome("the clock is set back by a day", ran.line("stops added"), "three stops", lost)


def _stops(store: Path) -> list[str]:
    """Return the captures of a store's only round, sorted; each stop must be whole."""
    from cucumbervision.store.repository import open_store

    with open_store(store, create=False) as opened:
        (one,) = opened.rounds()
        stops = [opened.stop(stop.key) for stop in opened.stops(one.key)]
        for fruit in opened.detections(one.key):
            opened.detection(fruit.key)
    return sorted(capture.name for stop in stops for capture in stop.captures)


def kill_rounds(
    folder: Path, kills: int, seed: int = 1, tick: Callable[[int], None] | None = None
) -> Outcome:
    """Kill `round add` with signal 9 at random moments and begin it again, until it is through.

    Parameters
    ----------
    folder : Path
        Empty.
    kills : int
        How many; a new round is begun whenever one is through before.
    seed : int
        Of the moments.
    tick : callable, optional
        Called with 1 after each kill.
    """
    from cucumbervision.store.images import check_store
    from cucumbervision.store.repository import open_store

    random, source = Random(seed), _captures(folder / "in", 8)
    killed, rounds = 0, 0
    lost: list[str] = []
    while killed < kills and not lost:
        rounds += 1
        store = folder / f"house{rounds}.db"
        _command("round", "new", "walk", "--store", store)
        there: list[str] = []
        while len(there) < 8 and killed < kills:
            killed += _killed_add(source, store, random)
            if tick is not None:
                tick(1)
            now = _stops(store)
            if set(there) - set(now) or len(set(now)) != len(now):
                lost.append(f"after {there} there was {now}")
            there = now
        _command("round", "add", source, "--store", store, "--instances", "dataset")
        if _stops(store) != [f"c{k}" for k in range(8)]:
            lost.append(f"at the end there was {_stops(store)}")
        with open_store(store, create=False) as opened:
            report = check_store(opened, grace_s=0, remove=True)
            if not check_store(opened, grace_s=0).sound:
                lost.append(f"pictures: {report}")
    kept = f"{rounds} rounds of 8 stops, each stop whole and once" if not lost else lost[0]
    seen = "nothing; the same command again goes on"
    return Outcome(f"`round add` killed {killed} times (kill -9)", seen, kept, bool(lost))


def _killed_add(source: Path, store: Path, random: Random) -> int:
    """Run `round add`, kill it within some stops after its first write, tell if it was killed."""
    code = (
        "from cucumbervision.store.repository import Store\nimport os, sys\n"
        "save = Store.save_stop\n"
        "def said(self, stop):\n    os.write(3, b'.')\n    return save(self, stop)\n"
        "Store.save_stop = said\nfrom cucumbervision.cli.app import main\nmain()"
    )
    heard, said = os.pipe()
    words = ("round", "add", source, "--store", store, "--instances", "dataset")
    process = subprocess.Popen(
        ["/bin/sh", "-c", f'exec "$@" 3>&{said}', "sh", sys.executable, "-c", code]
        + [str(word) for word in words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=(said,),
    )
    os.close(said)
    os.read(heard, 1)  # a stop is being written, or the program is through
    # Most writes take some milliseconds: most kills fall into one.
    time.sleep(random.choice((0.0, random.uniform(0, 0.02), random.uniform(0, 0.5))))
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGKILL)
    os.close(heard)
    return int(process.wait() == -signal.SIGKILL)


FAULTS: dict[str, Callable[[Path], Outcome]] = {
    "truncated": _truncated,
    "flipped": _flipped,
    "folder": _folder_gone,
    "disk": _disk_full,
    "permission": _no_permission,
    "unreadable": _unreadable_folder,
    "postgres": _postgres_gone,
    "camera": _camera_gone,
    "clock": _clock_back,
}


def try_faults(
    names: Sequence[str] = (),
    kills: int = 0,
    seed: int = 1,
    tick: Callable[[int], None] | None = None,
) -> list[Outcome]:
    """Try faults, each in an empty folder.

    Parameters
    ----------
    names : sequence of str
        Keys of `FAULTS`; all without one.
    kills : int
        How often to kill a round besides.
    seed : int
        Of the kills.
    tick : callable, optional
        Called with 1 after each fault and each kill.

    Returns
    -------
    list of Outcome
        One that cannot be tried here says so, and counts as not lost.
    """
    if unknown := [name for name in names if name not in FAULTS]:
        raise CucumberVisionError(
            f"no fault is called {unknown[0]!r}", remedy=f"take {', '.join(FAULTS)}"
        )
    found = []
    for name in names or FAULTS:
        with tempfile.TemporaryDirectory(prefix="fault-") as tmp:
            folder = Path(tmp) / "trial"
            folder.mkdir()
            try:
                one = FAULTS[name](folder)
            except CucumberVisionError as error:
                one = Outcome(name, f"could not be tried here: {error}", "")
            found.append(_without(one, str(folder)))
        if tick is not None:
            tick(1)
    if kills:
        with tempfile.TemporaryDirectory(prefix="fault-") as tmp:
            found.append(kill_rounds(Path(tmp), kills, seed, tick))
    return found


def _without(one: Outcome, folder: str) -> Outcome:
    seen = one.seen.replace(f"{folder}/", "").replace(folder, "").replace("cucumbervision: ", "")
    return Outcome(one.fault, seen, one.kept, one.lost)
