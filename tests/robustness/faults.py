"""Inject faults into real commands; print what the user sees and what is left.

    python -m tests.robustness.faults [FAULT...] [--kills N] [--seed N] [--counts FILE]

The exit code is 1 if something was lost. The full disk is a small file system in memory, which
needs root; PostgreSQL and S3 are servers on loopback.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.robustness.counted import add_counts
from tests.robustness.round_kills import kill_rounds
from tests.robustness.trial import (
    MASKS,
    Outcome,
    begin,
    captures,
    command,
    ended,
    rows_in,
    rows_of,
    stops_in,
)

from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence


def _truncated(folder: Path) -> Outcome:
    return _damaged_picture(folder, "a depth picture is cut in half", lambda d: d[: len(d) // 2])


def _flipped(folder: Path) -> Outcome:
    def flip(data: bytes) -> bytes:
        return data[:500] + bytes([data[500] ^ 8]) + data[501:]

    return _damaged_picture(folder, "a bit of a depth picture is flipped", flip)


def _damaged_picture(folder: Path, fault: str, damage: Callable[[bytes], bytes]) -> Outcome:
    source = captures(folder / "in")
    command("measure", source, "--out", folder / "whole", *MASKS)
    file = source / "c1" / "depth_000000.png"
    file.write_bytes(damage(file.read_bytes()))
    ran = command("measure", source, "--out", folder / "out", *MASKS)
    wanted = rows_of(rows_in(folder / "whole"), "c0", "c2")
    lost = rows_in(folder / "out") != wanted or ran.code != 1
    return Outcome(fault, ran.line("depth_000000"), "the rows of the two others", lost)


def _folder_gone(folder: Path) -> Outcome:
    source = captures(folder / "in")
    command("measure", source, "--out", folder / "whole", *MASKS)
    # As soon as the first picture of the run is drawn, what is left to read goes.
    gone = (
        "import shutil\nfrom cucumbervision.pipeline.run import FolderWorker\n"
        "add = FolderWorker.draw\n"
        f"gone = {str(source)!r}\n"
        "def once(self, result):\n    add(self, result)\n    shutil.rmtree(gone, True)\n"
        "FolderWorker.draw = once"
    )
    ran = command("measure", source, "--out", folder / "out", *MASKS, before=gone)
    whole, rows = rows_in(folder / "whole"), rows_in(folder / "out")
    # The second one may have been read while the first was measured.
    lost = rows not in (rows_of(whole, "c0"), rows_of(whole, "c0", "c1")) or ran.code != 1
    return Outcome("the folder goes in mid-run", ran.line("c2"), "the rows of what was read", lost)


@contextmanager
def _small_disk(folder: Path, size: str) -> Iterator[str]:
    """Limit the room of a folder: a small file system of its own, where one can be mounted."""
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
    source = captures(folder / "in", 6)
    command("measure", source, "--out", folder / "whole", *MASKS)
    one = sum(p.stat().st_size for p in (folder / "whole" / "overlays").iterdir()) // 6
    with _small_disk(folder / "disk", f"{(3 * one) // 1024 + 64}k") as disk:
        ran = command("measure", source, "--out", f"{disk}/out", *MASKS)
        subprocess.run(["mount", "-o", "remount,size=64m", disk], check=True)
        again = command("measure", source, "--out", f"{disk}/out", *MASKS)
        rows = rows_in(Path(disk) / "out")
    lost = rows != rows_in(folder / "whole") or ran.code not in (1, 2) or again.code != 0
    kept = "the journal; with room again the same command goes on to all rows"
    return Outcome("the disk is full (tmpfs)", ran.line("No space"), kept, lost)


def _no_permission(folder: Path) -> Outcome:
    source, out = captures(folder / "in"), folder / "out"
    out.mkdir(mode=0o555)
    ran = command("measure", source, "--out", out / "new", *MASKS, bound=os.getuid() == 0)
    lost = ran.code != 2 or any(out.iterdir())
    return Outcome("no permission to write", ran.line("cucumbervision:"), "nothing begun", lost)


def _unreadable_folder(folder: Path) -> Outcome:
    source, out = captures(folder / "in", 2), folder / "out"
    (source / "c1").chmod(0)
    ran = command("measure", source, "--out", out, *MASKS, bound=os.getuid() == 0)
    (source / "c1").chmod(0o755)
    lost = ran.code != 1 or not rows_of(rows_in(out), "c0") or "c1" not in ran.said
    return Outcome("a folder may not be read", ran.line("c1"), "the row of the other", lost)


def _postgres_gone(folder: Path) -> Outcome:
    from sqlalchemy import event
    from tests.greenhouse.store.throwaway_postgres import missing_reason, throwaway_cluster
    from tests.robustness.seeds import stop_of

    from cucumbervision_greenhouse.store.repository import open_store

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


def _postgres_full(folder: Path) -> Outcome:
    """Fill the disk of PostgreSQL's data while stops are saved, and make room again."""
    from tests.greenhouse.store.throwaway_postgres import missing_reason, throwaway_cluster
    from tests.robustness.made_stops import made_round, made_stop

    from cucumbervision_greenhouse.store.repository import open_store

    if reason := missing_reason():
        raise CucumberVisionError(reason)
    for above in (folder.parent, folder):
        above.chmod(0o711)  # the server is no root
    walk, sent, seen = made_round("walk"), 0, ""
    with (
        _small_disk(folder / "disk", "140m") as disk,
        throwaway_cluster(within=Path(disk)) as cluster,
        open_store(cluster.new_database(), images=folder / "pictures") as store,
    ):
        store.save_round(walk)
        ballast = Path(disk) / "ballast"
        ballast.write_bytes(bytes(shutil.disk_usage(disk).free - 1024**2))
        while not seen and sent < 500:
            try:
                store.save_stop(made_stop(walk, sent))
                sent += 1
            except CucumberVisionError as error:
                seen = str(error)
        whole = len(store.stops(walk.key)) == sent
        ballast.unlink()
        store.save_stop(made_stop(walk, sent))
        there = [store.stop(one.key) for one in store.stops(walk.key)]
    lost = not whole or there != [made_stop(walk, k) for k in range(sent + 1)]
    kept = "every stop acknowledged, no half one; with room again the next is taken"
    return Outcome("PostgreSQL's disk is full (tmpfs)", seen, kept, lost or "room" not in seen)


def _camera_gone(folder: Path) -> Outcome:
    from tests.robustness.seeds import recording

    from cucumbervision.capture.realsense import AlignedStream, play_file

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
    source, store = captures(folder / "in"), folder / "house.db"
    command("round", "new", "walk", "--store", store)
    command("round", "add", source / "c0", "--store", store, "--instances", "dataset")
    back = "import time\nnow = time.time\ntime.time = lambda: now() - 86400"
    add = ("round", "add", source, "--store", store, "--instances", "dataset")
    ran = command(*add, before=back)
    lost = stops_in(store) != ["c0", "c1", "c2"]
    return Outcome("the clock is set back by a day", ran.line("stops added"), "three stops", lost)


def _clock_jumps(folder: Path) -> Outcome:
    """Set the clock an hour back or forth at every third question, in a batch and in a round."""
    source, store = captures(folder / "in"), folder / "house.db"
    jumps = (
        "import itertools, time\nnow, asked = time.time, itertools.count()\n"
        "time.time = lambda: now() + (0, 3600, -3600)[next(asked) // 3 % 3]"
    )
    command("measure", source, "--out", folder / "whole", *MASKS)
    ran = command("measure", source, "--out", folder / "out", *MASKS, before=jumps)
    again = command("measure", source, "--out", folder / "out", *MASKS, before=jumps)
    command("round", "new", "walk", "--store", store, before=jumps)
    add = ("round", "add", source, "--store", store, "--instances", "dataset")
    added = [command(*add, before=jumps) for _ in range(2)]
    check = command("round", "check", "--store", store, before=jumps)
    rows, stops = rows_in(folder / "out"), stops_in(store)
    lost = any(one.code for one in (ran, again, *added, check))
    lost = lost or rows != rows_in(folder / "whole") or stops != ["c0", "c1", "c2"]
    kept = f"{len(rows)} rows, as without; {len(stops)} stops"
    return Outcome("the clock jumps by an hour", ran.line("fruit measured"), kept, lost)


def _many_instances(folder: Path) -> Outcome:
    """Name 100,000 fruit of 10,000 pictures in one COCO file; three of them are measured."""
    source = captures(folder / "in")
    images = [{"id": n, "file_name": f"c{n}"} for n in range(10_000)]
    boxes = [[60 + 70 * k, 100, 60, 150] for k in range(10)]
    for name, most in (("few", 3), ("many", 10_000)):
        fruit = [
            {"image_id": n, "category_id": 1, "bbox": box} for n in range(most) for box in boxes
        ]
        said = {"images": images[:most], "annotations": fruit, "categories": []}
        (folder / f"{name}.json").write_text(json.dumps(said))
        told = ("--instances", folder / f"{name}.json", *MASKS[2:])
        ran = command("measure", source, "--out", folder / name, *told)
    rows = rows_in(folder / "many")
    lost = len(rows) != 30 or rows != rows_in(folder / "few") or ran.code not in (0, 1)
    kept = f"{len(rows)} rows, as with those three alone"
    return Outcome("100,000 fruit in one COCO file", ran.line("fruit measured"), kept, lost)


def _kill_worker(folder: Path) -> Outcome:
    """Kill one of two workers of `measure` in the middle of its work."""
    source = captures(folder / "in", 6)
    command("measure", source, "--out", folder / "whole", *MASKS)
    once = (
        "import os, signal\nfrom cucumbervision.pipeline import batch\n"
        "submit, count = batch._Pool.submit, [0]\n"
        "def killing(self, task):\n    future = submit(self, task)\n    count[0] += 1\n"
        "    if count[0] == 4:\n"
        "        os.kill(next(iter(self._pool._processes)), signal.SIGKILL)\n"
        "        os.write(2, b'killed a worker\\n')\n    return future\n"
        "batch._Pool.submit = killing"
    )
    ran = command("measure", source, "--out", folder / "out", "--workers", 2, *MASKS, before=once)
    rows = rows_in(folder / "out")
    lost = ran.code != 0 or "killed a worker" not in ran.said or rows != rows_in(folder / "whole")
    kept = f"{len(rows)} of {len(rows_in(folder / 'whole'))} rows, those of one worker"
    return Outcome("a worker is killed (kill -9)", ran.line("fruit measured"), kept, lost)


def _kill_measure(folder: Path) -> Outcome:
    """Kill `measure` after two captures of six, while two workers measure; then begin it again."""
    source, out = captures(folder / "in", 6), folder / "out"
    command("measure", source, "--out", folder / "whole", *MASKS)
    once = (
        "import os, signal\nfrom cucumbervision.pipeline.folder import Journal\n"
        "append, count = Journal.append, [0]\n"
        "def killing(self, record):\n    append(self, record)\n    count[0] += 1\n"
        "    if count[0] == 2:\n        os.kill(os.getpid(), signal.SIGKILL)\n"
        "Journal.append = killing"
    )
    words = ("measure", source, "--out", out, "--workers", 2, *MASKS)
    ran = command(*words, before=once)  # returns when its workers have ended, too
    half = list(out.glob("measurements.*"))
    again = command(*words)
    rows = rows_in(out)
    lost = ran.code != -signal.SIGKILL or bool(half) or rows != rows_in(folder / "whole")
    kept = f"the same command again: {again.line('fruit measured')}"
    lost = lost or again.code != 0 or "2 of them by an earlier run" not in kept
    return Outcome("`measure` itself is killed (kill -9)", "no tables yet", kept, lost)


_KEYS = {"AWS_ACCESS_KEY_ID": "house", "AWS_SECRET_ACCESS_KEY": "cucumber"}


def s3_gone(folder: Path, gone_s: float = 60.0) -> Outcome:
    """Stop an S3 server on loopback in the middle of `measure`, and start it again.

    Parameters
    ----------
    folder : Path
        Empty.
    gone_s : float
        Seconds without a server.
    """
    with _s3_server() as server:
        url = "http://{}:{}".format(*server.get_host_and_port())
        env = {"AWS_ENDPOINT_URL": url, "AWS_DEFAULT_REGION": "us-east-1", **_KEYS}
        store = _s3(url)
        store.mkdir("house")
        store.put(str(captures(folder / "in", 6)), "house/captures", recursive=True)
        words = ("measure", "s3://house/captures", *MASKS)
        command(*words, "--out", folder / "whole", env=env)
        process = begin(*words, "--out", "s3://house/out", env=env)
        while process.poll() is None and not store.glob("house/out/overlays/*.png"):
            time.sleep(0.05)
        server.stop()
        time.sleep(gone_s)
        met = process.poll() is None
        server.start()
        ran = ended(process)
        store = _s3(url)
        (folder / "out").mkdir()
        store.get("house/out/measurements.csv", str(folder / "out" / "measurements.csv"))
    whole, rows = rows_in(folder / "whole"), rows_in(folder / "out")
    kept = f"{len(rows)} of {len(whole)} rows; the run waited and went on"
    seen = ran.line("does not answer").replace(url, "the server")
    lost = not met or ran.code != 0 or rows != whole
    return Outcome(f"S3 is gone for {gone_s:.0f} s", seen, kept, lost)


@contextmanager
def _s3_server() -> Iterator[Any]:
    """Run an S3 server; what it holds outlives its stops."""
    try:
        from moto.server import ThreadedMotoServer
    except ImportError:
        raise CucumberVisionError(
            "moto is not installed", remedy="pip install moto[s3,server]"
        ) from None
    from urllib.request import Request, urlopen

    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # else it prints each request
    server = ThreadedMotoServer("127.0.0.1", _free_port(), verbose=False)
    server.start()
    # What an earlier server of this process held is still there.
    reset = "http://{}:{}/moto-api/reset".format(*server.get_host_and_port())
    urlopen(Request(reset, method="POST")).close()
    try:
        yield server
    finally:
        server.stop()


def _free_port() -> int:
    """Return a port that the server gets again when it is started anew."""
    import socket

    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def _s3(url: str) -> Any:
    from importlib import import_module

    # It has no types.
    return import_module("s3fs").S3FileSystem(
        endpoint_url=url,
        key=_KEYS["AWS_ACCESS_KEY_ID"],
        secret=_KEYS["AWS_SECRET_ACCESS_KEY"],
        use_listings_cache=False,
        skip_instance_cache=True,
    )


FAULTS: dict[str, Callable[[Path], Outcome]] = {
    "truncated": _truncated,
    "flipped": _flipped,
    "folder": _folder_gone,
    "disk": _disk_full,
    "permission": _no_permission,
    "unreadable": _unreadable_folder,
    "worker": _kill_worker,
    "measure": _kill_measure,
    "s3": s3_gone,
    "postgres": _postgres_gone,
    "postgres-full": _postgres_full,
    "camera": _camera_gone,
    "clock": _clock_back,
    "jumps": _clock_jumps,
    "instances": _many_instances,
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


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("faults", nargs="*", metavar="FAULT", help=", ".join(FAULTS))
    parser.add_argument("--kills", type=int, default=0, help="also kill `round add` this often")
    parser.add_argument("--seed", type=int, default=1, help="of the moments of the kills")
    parser.add_argument("--counts", type=Path, help="file to which the counts are added")
    given = parser.parse_args()
    found = try_faults(given.faults, given.kills, given.seed)
    if given.counts is not None:
        lost = Counter("lost" if one.lost else "kept everything" for one in found)
        add_counts(given.counts, "faults", lost)
    for one in found:
        state = "LOST" if one.lost else "nothing lost"
        sys.stdout.write(f"{one.fault}: {state}\n  seen: {one.seen}\n  left: {one.kept}\n")
    return int(any(one.lost for one in found))


if __name__ == "__main__":
    sys.exit(main())
