"""The way from the start of the program to the first result."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from figures import Figure

from cucumbervision.capture.source import example_captures

_START = """
import sys, time
from cucumbervision.cli import app
from cucumbervision.run import whole_run as run
take = run._Run._take
def first(self, *given):
    done = take(self, *given)
    print('first', time.time(), flush=True)
    return done
run._Run._take = first
sys.argv = ['cucumbervision', *sys.argv[1:]]
app.main()
"""


def started(compiled: Path, *words: str) -> float:
    """Return the seconds from the process's start to the first saved capture.

    Python keeps what it compiled of the sources in a folder, as it does where they are installed.
    """
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(compiled)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as tmp:
        capture, out = str(example_captures() / "simulated-row-b"), str(Path(tmp) / "out")
        command = [sys.executable, "-c", _START, "measure", capture, "--out", out, *words]
        begun = time.time()
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    found = re.search(r"first ([\d.]+)", done.stdout)
    if found is None:
        raise SystemExit(done.stdout + done.stderr)
    return float(found[1]) - begun


def start(quick: bool) -> list[Figure]:
    """Time the way to the first result."""
    runs = 1 if quick else 5
    ways = {
        "start to first result, all networks": ("--instances", "models"),
        "start to first result, given masks": ("--instances", "dataset"),
    }
    taken: dict[str, list[float]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as compiled:
        for _ in range(1 + runs):
            for name, words in ways.items():
                taken[name].append(started(Path(compiled), *words))
    return [Figure(name, median(all_s[1:]), "s", "<= 3") for name, all_s in taken.items()]
