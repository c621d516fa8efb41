"""Whether a batch's memory and time a capture stay flat: `measure` over thousands of captures.

    python benchmarks/long_batch.py [--captures 10000] [--methods M1,M5]

Small drawn captures with a fruit and its mask each, none like another, are measured into a folder
as `cucumbervision measure --instances dataset` does: read, measured, drawn, journalled, and made
into tables at the end. Printed are the process's memory and the processor time a capture after each
tenth, and after the tables. Exit code 1 if memory at the end is over that after the first tenth by
more than 10 %.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from bench_frame import peak_mib
from kill_batch import draw_house

from cucumbervision.pipeline.options import MeasureOptions, parse_methods
from cucumbervision.pipeline.run import measure_inputs
from cucumbervision.pipeline.work import Outcome

GROWTH = 1.10


def held_mib() -> float:
    """Return the memory that this process holds now, in MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


class Watch:
    """Prints memory and time after each tenth of the captures."""

    def __init__(self, captures: int) -> None:
        self.step = max(1, captures // 10)
        self.done = 0
        self.held: list[float] = []
        self._since = time.process_time()

    def __call__(self, outcome: Outcome) -> None:
        """Count a capture."""
        if outcome.failures:
            raise SystemExit(outcome.failures[0].message)
        self.done += 1
        if self.done % self.step == 0:
            busy, self._since = time.process_time() - self._since, time.process_time()
            self.held.append(held_mib())
            print(f"{self.done:8} {self.held[-1]:10.1f} {1e3 * busy / self.step:14.2f}", flush=True)


def main() -> None:
    """Draw, measure, and say whether memory stayed flat."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=10_000)
    parser.add_argument("--methods", default="M1,M5")
    arguments = parser.parse_args()
    options = MeasureOptions(instances="dataset", methods=parse_methods(arguments.methods))
    with tempfile.TemporaryDirectory() as tmp:
        house, out = Path(tmp) / "house", Path(tmp) / "out"
        draw_house(house, arguments.captures)
        print(f"captures  held, MiB  processor, ms a capture ({arguments.methods})")
        watch = Watch(arguments.captures)
        result = measure_inputs([house], out, options, watch)
        print(f"{'tables':8} {held_mib():10.1f}")
    first, last = watch.held[0], watch.held[-1]
    flat = last <= GROWTH * first and result.captures == result.summary.fruit == arguments.captures
    print(
        f"{result.captures:,} captures, {result.summary.fruit:,} fruit; {first:.0f} MiB after "
        f"{watch.step:,}, {last:.0f} MiB after {watch.done:,}, {peak_mib():.0f} MiB at most: "
        f"{'flat' if flat else 'NOT FLAT'}"
    )
    sys.exit(not flat)


if __name__ == "__main__":
    main()
