"""The program killed with signal 9: a worker, the command itself, and a round again and again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from random import Random
from typing import TYPE_CHECKING

from cucumbervision_lab.robustness.trial import (
    MASKS,
    Outcome,
    captures,
    command,
    rows_in,
    stops_in,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def kill_worker(folder: Path) -> Outcome:
    """Kill one of two workers of `measure` in the middle of its work."""
    source = captures(folder / "in", 6)
    command("measure", source, "--out", folder / "whole", *MASKS)
    once = (
        "import os, signal\nfrom cucumbervision.pipeline import engines\n"
        "submit, count = engines._Pool.submit, [0]\n"
        "def killing(self, task):\n    future = submit(self, task)\n    count[0] += 1\n"
        "    if count[0] == 4:\n"
        "        os.kill(next(iter(self._pool._processes)), signal.SIGKILL)\n"
        "        os.write(2, b'killed a worker\\n')\n    return future\n"
        "engines._Pool.submit = killing"
    )
    ran = command("measure", source, "--out", folder / "out", "--workers", 2, *MASKS, before=once)
    rows = rows_in(folder / "out")
    lost = ran.code != 0 or "killed a worker" not in ran.said or rows != rows_in(folder / "whole")
    kept = f"{len(rows)} of {len(rows_in(folder / 'whole'))} rows, those of one worker"
    return Outcome("a worker is killed (kill -9)", ran.line("fruit measured"), kept, lost)


def kill_measure(folder: Path) -> Outcome:
    """Kill `measure` after two captures of six, while two workers measure; then begin it again."""
    source, out = captures(folder / "in", 6), folder / "out"
    command("measure", source, "--out", folder / "whole", *MASKS)
    once = (
        "import os, signal\nfrom cucumbervision.pipeline.journal import Journal\n"
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

    random, source = Random(seed), captures(folder / "in", 8)
    killed, rounds = 0, 0
    lost: list[str] = []
    while killed < kills and not lost:
        rounds += 1
        store = folder / f"house{rounds}.db"
        command("round", "new", "walk", "--store", store)
        there: list[str] = []
        while len(there) < 8 and killed < kills:
            killed += _killed_add(source, store, random)
            if tick is not None:
                tick(1)
            now = stops_in(store)
            if set(there) - set(now) or len(set(now)) != len(now):
                lost.append(f"after {there} there was {now}")
            there = now
        command("round", "add", source, "--store", store, "--instances", "dataset")
        if stops_in(store) != [f"c{k}" for k in range(8)]:
            lost.append(f"at the end there was {stops_in(store)}")
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
    for _ in range(random.choice((1, 1, 2, 3))):
        os.read(heard, 1)  # a stop is being written, or the program is through
    # Most writes take some milliseconds: most kills fall into one.
    time.sleep(random.choice((0.0, random.uniform(0, 0.02), random.uniform(0, 0.5))))
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGKILL)
    os.close(heard)
    return int(process.wait() == -signal.SIGKILL)
