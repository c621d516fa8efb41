"""Quick ratios beside their limits, in processor time: what CI runs."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.run.batch import in_process
from cucumbervision.tube.compiled import kernel_name
from speeds.frames import GIVEN, pace
from speeds.kernels import draw_region, milliseconds, timed, times_the_floor

TRIES = 4


LIMITS = {
    "M1 to M5, times the plain NumPy floor": 4.0,
    "M6, times the plain NumPy floor": 15.0 if kernel_name() == "numpy" else 9.0,
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
    captures = list(open_source(example_captures()))

    def read() -> None:
        for ref in captures:
            ref.load()

    read()
    reading_s = 1e-3 * milliseconds(read) / len(captures)
    return pace(GIVEN, in_process, 9, 3, time.process_time) / reading_s


def check() -> int:
    """Print each quick ratio beside its limit: what CI runs. The best of a few tries counts."""
    drawn = draw_region()
    turns = [timed(drawn, 20) for _ in range(TRIES)]
    ratios = (
        min(times_the_floor(floors, papers) for floors, papers, _ in turns),
        min(times_the_floor(floors, m6) for floors, _, m6 in turns),
        min(times_its_reading() for _ in range(TRIES)),
        help_times_its_libraries(),
    )
    for (name, limit), ratio in zip(LIMITS.items(), ratios, strict=True):
        print(f"{name}: {ratio:.2f} (limit {limit:.2f}) {'ok' if ratio <= limit else 'TOO SLOW'}")
    return int(any(ratio > limit for ratio, limit in zip(ratios, LIMITS.values(), strict=True)))
