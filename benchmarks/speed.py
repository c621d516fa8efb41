"""Speed as ratios that are measured side by side; only ratios mean anything on a shared machine.

    python benchmarks/speed.py [PART ...] [--quick]
    python benchmarks/speed.py dashboard    # in Chromium, with what the tests draw
    python benchmarks/speed.py gpu     # on a machine with an NVIDIA GPU: frames a second
    python benchmarks/speed.py --check     # limits for CI, in processor time

Parts: pipeline, start, kernels, workers, dashboard. `kernels` compares with skan on a mask, and
names what is not installed. Each prints a table, row by row. The exit code is 1 if an aim or a
limit is missed.

`gpu` runs only where it is named. It needs onnxruntime-gpu in place of onnxruntime, and takes 2
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

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for what the tests draw

from speeds.timing import HEAD, Figure, as_row, machine

FILES = {"pipeline": "batch", "start": "batch", "kernels": "kernels", "workers": "batch"}
FILES["dashboard"] = "dashboard"
PARTS = (*FILES, "gpu")


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
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--quick", action="store_true", help="a few rounds of each")
    parser.add_argument("--check", action="store_true", help="compare quick ratios with limits")
    arguments = parser.parse_args()
    if arguments.check:
        sys.exit(import_module("speeds.kernels").check())
    if unknown := set(arguments.parts) - {*PARTS}:
        parser.error(f"no part is called {', '.join(unknown)}; take {', '.join(PARTS)}")
    parts: dict[str, Callable[[bool], Iterable[Figure]]] = {}
    for name in arguments.parts or FILES:  # only what is timed is imported
        module = import_module(f"speeds.{FILES.get(name, 'batch')}")
        parts |= module.gpu_parts() if name == "gpu" else {name: getattr(module, name)}
    verdicts = [print_part(name, part, arguments.quick) for name, part in parts.items()]
    sys.exit(not all(verdicts))


if __name__ == "__main__":
    main()
