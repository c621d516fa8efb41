"""Whether a batch survives: `measure` is killed with signal 9 again and again, and goes on.

    python -m tests.robustness.kill_batch [--kills 20] [--captures 40] [--seed 1]

A child process measures drawn captures into a folder as `cucumbervision measure` does, and says
when a record of its journal is on disk. It is killed at a random moment: in every fourth run while
it starts and looks through the journal, else after the first acknowledged record, and then three
times of four in the middle of a write, at random which: of a picture, a record or a table, by half.
After each kill every acknowledged record must be there and whole, and no table half written; at the
end a run without kills must leave the tables of a run that was never killed, each row once, and its
pictures. Exit code 1 if anything was lost or doubled.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.measurement.result import MethodName
from cucumbervision.pipeline.folder import Journal, OutputFolder
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.run import Step, measure_inputs

OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M1,))
TABLES = ("measurements.csv", "failures.csv")


def draw_house(folder: Path, captures: int) -> None:
    """Write small captures with a fruit each, none like another."""
    camera = Intrinsics(96, 64, 90.0, 90.0, 47.5, 31.5)
    for number in range(captures):
        mask = np.zeros((64, 96), bool)
        mask[10 : 30 + number % 29, 40:52] = True
        depth_m = np.where(mask, 0.5 + 0.001 * (number % 397), 0.9).astype(np.float32)
        color = np.full((64, 96, 3), 60 + number % 97, np.uint8)
        name = f"stop-{number:04d}"
        write_native(Capture(color, depth_m, camera, name, masks=(mask,)), folder / name)


@dataclass(frozen=True)
class Blow:
    """When a child is killed: after seconds, or (`write` above 0) by half of its nth write."""

    at_start: bool
    delay_s: float
    write: int


def child(house: Path, out: Path, blow: Blow, said: int) -> None:
    """Measure, and write a line for each record that is acknowledged."""
    acknowledged = 0

    def tell(outcome: Step) -> None:
        nonlocal acknowledged
        if outcome.record is not None and not outcome.before:
            acknowledged += 1
            os.write(said, f"{outcome.record.place}\n".encode())

    if blow.write:
        die_in_write(blow.write, lambda: acknowledged > 0)
    measure_inputs([house], out, OPTIONS, tell)


def die_in_write(number: int, begun: Any) -> None:
    """Kill this process within its nth write of a file once `begun` says so."""
    real, count = open_file, 0

    class Dying:
        """A file whose nth write is its process's last, and reaches the disk by half."""

        def __init__(self, file: Any) -> None:
            self._file = file

        def write(self, data: Any) -> Any:
            nonlocal count
            count += begun()
            if count == number:
                self._file.write(data[: len(data) // 2])
                self._file.flush()
                os.kill(os.getpid(), signal.SIGKILL)
            return self._file.write(data)

        def __enter__(self) -> Dying:
            return self

        def __exit__(self, *_: object) -> None:
            self._file.close()

        def __getattr__(self, name: str) -> Any:
            return getattr(self._file, name)

    def opened(path: Path, mode: str = "r", *rest: Any, **more: Any) -> Any:
        file = real(path, mode, *rest, **more)
        return Dying(file) if set(mode) & set("wx") else file

    Path.open = opened  # type: ignore[method-assign, assignment]


open_file = Path.open


def run_child(house: Path, out: Path, blow: Blow) -> tuple[list[str], bool]:
    """Start a child and kill it; give the places it acknowledged, and whether it was killed."""
    heard, said = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.close(heard)
            child(house, out, blow, said)
            code = 0
        finally:
            os._exit(code)
    os.close(said)
    text = b"" if blow.at_start else os.read(heard, 4096)
    if not blow.write:
        select.select([], [], [], blow.delay_s)
        os.kill(pid, signal.SIGKILL)
    while piece := os.read(heard, 65536):
        text += piece
    os.close(heard)
    _, status = os.waitpid(pid, 0)
    if not os.WIFSIGNALED(status) and os.WEXITSTATUS(status):
        raise SystemExit("the child failed by itself")
    return text.decode().split(), os.WIFSIGNALED(status)


def faults_after(out: Path, acknowledged: set[str]) -> list[str]:
    """Hold a folder after a kill against what was acknowledged."""
    faults = []
    with Journal(OutputFolder(out)) as journal:
        for place in acknowledged:
            record = journal.find(place)
            if record is None or record.picture is None:
                faults.append(f"{place} was acknowledged and is lost")
            elif not (out / record.picture).read_bytes().endswith(b"IEND\xaeB`\x82"):
                faults.append(f"{record.picture} is no whole picture")
    for table in TABLES:
        if (out / table).exists() and not (out / table).read_bytes().endswith(b"\r\n"):
            faults.append(f"{table} was written by half")
    if (out / "measurements.json").exists():
        json.loads((out / "measurements.json").read_text(encoding="utf-8"))
    return faults


def final_faults(house: Path, out: Path, whole: Path) -> list[str]:
    """Finish the batch without kills, and compare it with one that was never killed."""
    measure_inputs([house], out, OPTIONS)
    measure_inputs([house], whole, OPTIONS)
    faults = []
    for table in TABLES:
        if (out / table).read_bytes() != (whole / table).read_bytes():
            faults.append(f"{table} is not that of a run that was never killed")
    with (out / "measurements.csv").open(newline="", encoding="utf-8-sig") as stream:
        rows = [(row["capture"], row["fruit"]) for row in csv.DictReader(stream)]
    if len(set(rows)) != len(rows):
        faults.append("a row is there twice")
    for picture in (whole / "overlays").iterdir():
        if (out / "overlays" / picture.name).read_bytes() != picture.read_bytes():
            faults.append(f"{picture.name} is another picture")
    return faults


def kill_all(folder: Path, kills: int, captures: int, seed: int) -> list[str]:
    """Kill a batch again and again; print what became of it and return what is wrong."""
    rng = random.Random(seed)
    house, out, whole = folder / "house", folder / "out", folder / "whole"
    draw_house(house, captures)
    acknowledged: set[str] = set()
    outcome: Counter[str] = Counter()
    faults: list[str] = []
    since = time.monotonic()
    while outcome["killed"] < kills and not faults:
        at_start = rng.random() < 0.25
        write = 0 if at_start or rng.random() < 0.25 else rng.randint(1, 3 * captures // 8)
        blow = Blow(at_start, rng.uniform(0, 0.2 if at_start else 0.1), write)
        places, killed = run_child(house, out, blow)
        acknowledged.update(places)
        faults += faults_after(out, acknowledged)
        outcome["killed"] += killed
        where = "while starting" if at_start else "inside a write" if write else "between writes"
        outcome[f"killed {where}" if killed else "ended before the kill"] += 1
        outcome["records acknowledged"] += len(places)
        if not killed:
            # All is done: what is to be killed begins anew.
            shutil.rmtree(out)
            acknowledged.clear()
            outcome["batches finished between kills"] += 1
    faults = faults or final_faults(house, out, whole)
    for name, count in sorted(outcome.items()):
        print(f"{name:32} {count}")
    print(f"{'seconds':32} {time.monotonic() - since:.0f}")
    return faults


def main() -> None:
    """Run and say what was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--captures", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        faults = kill_all(Path(folder), arguments.kills, arguments.captures, arguments.seed)
    for fault in faults:
        print(fault)
    print(
        f"{arguments.kills} kills: " + ("NOT SAFE" if faults else "nothing lost, nothing doubled")
    )
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
