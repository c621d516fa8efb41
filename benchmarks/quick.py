"""The quick form of the speed benchmarks, with limits: what CI runs.

    python benchmarks/quick.py

Ratios are of processor time, taken side by side in one run, and the best of a few tries counts,
since the machines are shared; a limit that is missed exits with 1.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # what is compared with the package too

import subprocess
import sys
import time

from bench_methods import draw_region, milliseconds, timed, times_the_floor
from speed import GIVEN, pace

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import bundled_captures
from cucumbervision.pipeline.engines import in_process

TRIES = 4
LIMITS = {
    "M1 to M5, times the plain NumPy floor": 4.0,
    "M6, times the plain NumPy floor": 15.0,
    "a capture with given masks, times its reading alone": 4.0,
    "cucumbervision --help, times Typer and NumPy alone": 3.5,
}


def children_s() -> float:
    """Return the processor time of all processes that were started and have ended."""
    times = os.times()
    return times.children_user + times.children_system


def help_times_its_libraries() -> float:
    """Compare the console script's help with a start that loads what it cannot do without."""

    def seconds(code: str) -> float:
        start = children_s()
        subprocess.run([sys.executable, "-c", code, "--help"], check=True, capture_output=True)
        return children_s() - start

    program, libraries = "from cucumbervision.cli.app import main; main()", "import typer, numpy"
    turns = [(seconds(program), seconds(libraries)) for _ in range(TRIES)]
    return min(own for own, _ in turns) / min(alone for _, alone in turns)


def times_its_reading() -> float:
    """Compare a capture's way through the pipeline with reading it: what is added to every one."""
    captures = list(open_source(bundled_captures()))

    def read() -> None:
        for ref in captures:
            ref.load()

    read()
    reading_s = 1e-3 * milliseconds(read) / len(captures)
    return pace(GIVEN, in_process, 9, 3, time.process_time) / reading_s


def main() -> int:
    """Print each figure beside its limit; give the exit code."""
    drawn = draw_region()
    turns = [timed(drawn, 20) for _ in range(TRIES)]
    found = {
        "M1 to M5, times the plain NumPy floor": min(times_the_floor(f, p) for f, p, _ in turns),
        "M6, times the plain NumPy floor": min(times_the_floor(f, m6) for f, _, m6 in turns),
        "a capture with given masks, times its reading alone": min(
            times_its_reading() for _ in range(TRIES)
        ),
        "cucumbervision --help, times Typer and NumPy alone": help_times_its_libraries(),
    }
    for name, value in found.items():
        verdict = "ok" if value <= LIMITS[name] else "TOO SLOW"
        print(f"{name}: {value:.2f} (limit {LIMITS[name]:.2f}) {verdict}")
    return int(any(value > LIMITS[name] for name, value in found.items()))


if __name__ == "__main__":
    sys.exit(main())
