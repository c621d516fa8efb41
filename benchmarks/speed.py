"""Speed as ratios that are measured side by side; only ratios mean anything on a shared machine.

    python benchmarks/speed.py [PART ...] [--quick]
    python benchmarks/speed.py dashboard    # in Chromium, with what the tests draw
    python benchmarks/speed.py card    # on a machine with an NVIDIA card: frames a second by stage
    python benchmarks/speed.py --check     # limits for CI, in processor time

Parts: pipeline, processor, start, kernels, peers, workers, dashboard. `peers` compares with
skan on a mask, and says what is not installed.
Each prints a table, row by row. The exit code is 1 if an aim or a limit is missed.

`card` runs only where it is named. It needs onnxruntime-gpu in place of onnxruntime, and takes 2
minutes on CUDA; where TensorRT is installed too, what it compiles at first takes some minutes more,
after the tables of CUDA. `timeout 600` keeps it within 12 minutes with the installation.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # what is compared with the package too

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for what the tests draw

from figures import HEAD, Figure, as_row, machine

PARTS = ("pipeline", "processor", "start", "kernels", "peers", "workers", "dashboard")


def part_of(name: str) -> Any:
    """Return the file of a part; only what is timed is imported."""
    return import_module(f"speeds.{name}")


def print_part(name: str, figures: Callable[[bool], Iterable[Figure]], quick: bool) -> bool:
    """Print each figure of a part as soon as it is known; return whether all aims are kept."""
    when = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    print(f"{name} ({when}; {machine()})\n{HEAD}", flush=True)
    is_kept = True
    for figure in figures(quick):
        print(as_row(figure), flush=True)
        is_kept &= figure.kept
    print(flush=True)
    return is_kept


def main() -> None:
    """Measure the parts, and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join([*PARTS, "card"]))
    parser.add_argument("--quick", action="store_true", help="a few rounds of each")
    parser.add_argument("--check", action="store_true", help="compare quick ratios with limits")
    arguments = parser.parse_args()
    if arguments.check:
        sys.exit(part_of("limits").check())
    if unknown := set(arguments.parts) - {*PARTS, "card"}:
        parser.error(f"no part is called {', '.join(unknown)}; take {', '.join([*PARTS, 'card'])}")
    parts: dict[str, Callable[[bool], Iterable[Figure]]] = {}
    for name in arguments.parts or PARTS:
        part = part_of(name)
        parts |= part.card_parts() if name == "card" else {name: getattr(part, name)}
    verdicts = [print_part(name, part, arguments.quick) for name, part in parts.items()]
    sys.exit(not all(verdicts))


if __name__ == "__main__":
    main()
