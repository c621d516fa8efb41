"""The quick form of the speed benchmarks, with limits: what CI runs.

    python benchmarks/quick.py

Ratios are taken side by side in one run and the best of a few tries counts, since the machines are
shared; a limit that is missed exits with 1.
"""

from __future__ import annotations

import subprocess
import sys
import time

from bench_methods import draw_region, timed, times_the_floor

TRIES = 4
LIMITS = {"M1 to M5, times the plain NumPy floor": 4.0, "cucumbervision --help, s": 0.5}


def help_seconds() -> float:
    """Time the console script's help, start-up included."""
    start = time.perf_counter()
    code = "from cucumbervision.cli.app import main; main()"
    subprocess.run([sys.executable, "-c", code, "--help"], check=True, capture_output=True)
    return time.perf_counter() - start


def main() -> int:
    """Print each figure beside its limit; give the exit code."""
    drawn = draw_region()
    floors = [times_the_floor(*timed(drawn, 20)[:2]) for _ in range(TRIES)]
    found = {
        "M1 to M5, times the plain NumPy floor": min(floors),
        "cucumbervision --help, s": min(help_seconds() for _ in range(TRIES)),
    }
    for name, value in found.items():
        verdict = "ok" if value <= LIMITS[name] else "TOO SLOW"
        print(f"{name}: {value:.2f} (limit {LIMITS[name]:.2f}) {verdict}")
    return int(any(value > LIMITS[name] for name, value in found.items()))


if __name__ == "__main__":
    sys.exit(main())
