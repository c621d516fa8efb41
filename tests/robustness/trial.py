"""A trial of the real program: its captures, what it says, and the rows that it leaves."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.source import example_captures

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MASKS = ("--instances", "dataset", "--segmenter", "none", "--methods", "M1,M2")
# Root may write anywhere: without these two it may as little as any owner.
_BOUND = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
_TABLE = "measurements.csv"
ALONE = "import os\nos.setpgrp()"
"""First thing of a program that Ctrl-C does not reach: whoever began it ends it."""


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
class Ran:
    """What a command said, and its exit code; below 0 the signal that ended it."""

    code: int
    said: str

    def line(self, word: str = "") -> str:
        """Return the last line with a word in it, without the folder of this trial."""
        return last_line(self.said, word)


def last_line(said: str, word: str = "") -> str:
    r"""Return the last line with a word in it; without such a one the last of all.

    Examples
    --------
    >>> last_line("2 stops added.\n1   failed\n", "failed")
    '1 failed'
    """
    lines = [" ".join(line.split()) for line in said.splitlines() if line.strip()]
    return ([line for line in lines if word in line] or lines or ["nothing"])[-1]


def begin(
    *words: object, before: str = "", bound: bool = False, env: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    """Start the program as a user does; `before` runs first in its process."""
    code = f"{before}\nfrom cucumbervision.cli.app import main\nmain()"
    return subprocess.Popen(
        [*(_BOUND if bound else ()), sys.executable, "-c", code, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "COLUMNS": "400", "PYTHONDONTWRITEBYTECODE": "1", **(env or {})},
    )


def ended(process: subprocess.Popen[str]) -> Ran:
    """Wait until a program, and whatever it started, has ended."""
    said, _ = process.communicate()
    return Ran(process.returncode, said)


def command(
    *words: object, before: str = "", bound: bool = False, env: Mapping[str, str] | None = None
) -> Ran:
    """Run the program as `begin` starts it."""
    return ended(begin(*words, before=before, bound=bound, env=env))


def captures(folder: Path, count: int = 3) -> Path:
    """Write some captures, all of them different, each at a stop of its own along the row."""
    from cucumbervision.capture.readers import open_source
    from cucumbervision.capture.readers.native import write_native

    one = next(iter(open_source(example_captures() / "simulated-row-b"))).load()
    for k in range(count):
        depth_m = one.depth_m + (one.depth_m > 0) * 0.001 * k
        stop = replace(one.stop, position_m=0.8 + 0.4 * k, step=2 + k)
        changed = replace(one, depth_m=depth_m.astype("float32"), name=f"c{k}", stop=stop)
        write_native(changed, folder / f"c{k}")
    return folder


def rows_in(out: Path) -> list[list[str]]:
    """Return a run's rows without what tells one run from another."""
    with (out / _TABLE).open(encoding="utf-8-sig", newline="") as stream:
        return [list(row.values()) for row in csv.DictReader(stream)]


def rows_of(rows: Sequence[Sequence[str]], *captures: str) -> list[Sequence[str]]:
    """Return the rows of some captures."""
    return [row for row in rows if set(captures) & set(row)]


def stops_in(store: Path) -> list[str]:
    """Return the captures of a store's only round, sorted; each stop must be whole."""
    from cucumbervision_greenhouse.store.repository import open_store

    with open_store(store, create=False) as opened:
        (one,) = opened.rounds()
        stops = [opened.stop(stop.key) for stop in opened.stops(one.key)]
        for fruit in opened.detections(one.key):
            opened.detection(fruit.key)
    return sorted(capture.name for stop in stops for capture in stop.captures)
