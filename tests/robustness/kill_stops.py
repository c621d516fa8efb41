"""Whether a stop survives: a program that saves stops is killed again and again.

    python -m tests.robustness.kill_stops [--url house.db] [--stops 100] [--kills 0] ...

A child process saves stops with their pictures and says when the store has acknowledged one. It
is killed with signal 9 at random moments, while it opens the store, writes pictures, or is within
a transaction; a new child then sends again from a few stops before the last acknowledged one.
After each kill every stop must be there whole or not at all, and every acknowledged one must be
there; at the end each must be there once, equal to what was sent, and its pictures with it.
PostgreSQL: --url postgresql://..., an empty database. Exit code 1 if anything was lost.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from sqlalchemy import func, select
from tests.robustness.made_stops import FRUIT, METHODS, made_round, made_stop

from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.schema import (
    CaptureLine,
    DetectionLine,
    MaskLine,
    MethodLine,
    StopLine,
)

RESENT = 3  # stops that a new child sends again although they were acknowledged
WALK = made_round("killed")


def child(url: str, images: Path, first: int, stops: int, said: int) -> None:
    """Save stops from `first` on, and write a line for each once it is acknowledged."""
    with open_store(url, images=images) as store:
        store.save_round(WALK)
        os.write(said, b"ready\n")
        for number in range(first, stops):
            saved = store.save_stop(made_stop(WALK, number, store.images))
            os.write(said, f"{number} {saved}\n".encode())


def run_child(
    url: str, images: Path, first: int, stops: int, after_s: tuple[bool, float]
) -> tuple[list[str], bool]:
    """Start a child and kill it; give what it said, and whether it was killed.

    `after_s` says whether to count from its start (or from when it is ready), and how long.
    """
    heard, said = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.close(heard)
            child(url, images, first, stops, said)
            code = 0
        except CucumberVisionError as error:
            os.write(said, f"failed {error}\n".encode())
        finally:
            os._exit(code)
    os.close(said)
    at_start, delay_s = after_s
    text = b"" if at_start else os.read(heard, 6)
    time.sleep(delay_s)
    os.kill(pid, signal.SIGKILL)
    while piece := os.read(heard, 65536):
        text += piece
    os.close(heard)
    _, status = os.waitpid(pid, 0)
    return text.decode().splitlines(), os.WIFSIGNALED(status)


def faults_of(store: Store, acknowledged: set[int]) -> tuple[set[str], list[str]]:
    """Count what belongs to each stop: give the keys that are there, and what is wrong."""
    counts = (
        select(
            StopLine.key,
            func.count(CaptureLine.id.distinct()),
            func.count(DetectionLine.id.distinct()),
            func.count(MaskLine.fruit_id.distinct()),
            func.count(MethodLine.fruit_id),
        )
        .outerjoin(CaptureLine, CaptureLine.stop_id == StopLine.id)
        .outerjoin(DetectionLine, DetectionLine.capture_id == CaptureLine.id)
        .outerjoin(MaskLine, MaskLine.fruit_id == DetectionLine.id)
        .outerjoin(MethodLine, MethodLine.fruit_id == DetectionLine.id)
        .group_by(StopLine.id, StopLine.key)
    )
    with begin(store.engine) as connection:
        found = connection.execute(counts).all()
    whole = (1, FRUIT, FRUIT, FRUIT * len(METHODS))
    faults = [f"stop {row[0]} is not whole: {row[1:]}" for row in found if tuple(row[1:]) != whole]
    keys = {row[0] for row in found}
    if len(keys) != len(found):
        faults.append("a stop is there twice")
    lost = sorted(n for n in acknowledged if made_stop(WALK, n).key not in keys)
    return keys, faults + [f"stop {n} was acknowledged and is lost" for n in lost]


def final_faults(store: Store, stops: int) -> list[str]:
    """Hold every stop against what was sent, and every picture against its hash."""
    faults = []
    for number in range(stops):
        sent = made_stop(WALK, number, store.images)
        if store.stop(sent.key) != sent:
            faults.append(f"stop {number} is not what was sent")
    found = store.detections(WALK.key)
    if len(found) != FRUIT * stops or len({one.key for one in found}) != len(found):
        faults.append(f"{len(found)} fruit instead of {FRUIT * stops}")
    before = check_store(store, grace_s=0, remove=True)
    print(f"pictures {before.pictures}, left over by kills and removed {len(before.removed)}")
    after = check_store(store, grace_s=0)
    if not after.sound or after.orphans:
        faults.append(f"pictures: {after}")
    return faults


def kill_all(url: str, images: Path, stops: int, kills: int, seed: int) -> tuple[int, list[str]]:
    """Kill children until all is acknowledged; give how many stops it were, and what went wrong.

    More stops than asked for are sent while fewer than `kills` children were killed.
    """
    rng = random.Random(seed)
    acknowledged: set[int] = set()
    outcome: Counter[str] = Counter()
    faults: list[str] = []
    stop_s = 0.05
    while (len(acknowledged) < stops or outcome["killed"] < kills) and not faults:
        stops = max(stops, len(acknowledged) + RESENT)
        first = max(0, len(acknowledged) - RESENT)
        at_start = rng.random() < 0.15
        delay_s = rng.uniform(0, 0.3) if at_start else rng.uniform(0, (RESENT + 3) * stop_s)
        began = time.perf_counter()
        lines, killed = run_child(url, images, first, stops, (at_start, delay_s))
        lines = [line for line in lines if line != "ready"]
        faults += [line for line in lines if line.startswith("failed")]
        numbers = [int(line.split()[0]) for line in lines if not line.startswith("failed")]
        before = set(acknowledged)
        acknowledged.update(numbers)
        if not at_start:
            new, took_s = len(set(numbers) - before), time.perf_counter() - began
            # Killed too soon to come further: on a busy machine a stop takes longer.
            stop_s = max(0.005, took_s / new) if new else 1.5 * stop_s
        with open_store(url, images=images) as store:
            keys, wrong = faults_of(store, acknowledged)
        faults += wrong
        in_flight = max(acknowledged, default=-1) + 1
        there = made_stop(WALK, in_flight).key in keys
        outcome["killed" if killed else "ended"] += 1
        outcome["stop there, not yet acknowledged"] += killed and there
        outcome["resent and already there"] += sum("already-there" in line for line in lines)
    print(", ".join(f"{name} {count}" for name, count in sorted(outcome.items())))
    with open_store(url, images=images) as store:
        return stops, faults or final_faults(store, len(acknowledged))


def main() -> None:
    """Run and say what was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="", help="an empty database; a new SQLite file by default")
    parser.add_argument("--images", type=Path)
    parser.add_argument("--stops", type=int, default=100)
    parser.add_argument("--kills", type=int, default=0, help="go on until as many were killed")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        url = arguments.url or str(Path(folder) / "house.db")
        images = arguments.images or Path(folder) / "images"
        stops, faults = kill_all(url, images, arguments.stops, arguments.kills, arguments.seed)
    for fault in faults:
        print(fault)
    print(f"{stops} stops: " + ("NOT SAFE" if faults else "none lost, none doubled"))
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
