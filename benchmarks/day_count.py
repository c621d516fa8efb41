"""How near a drawn day's count comes to the truth, before and after a person's taps.

    OMP_NUM_THREADS=1 python benchmarks/day_count.py --seeds 20

Two rows of 200 fruit (`cucumbervision_lab.simulation`), both aisles walked, stops 3 cm from where
the operator says, 5 % of the visible fruit missed in each picture, 2 % of the finds invented. A
tap answers what the row map asks of the fruit that it doubts most: a fruit of its own, no fruit at
all, or another view of its neighbour.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cucumbervision.rounds.merge import ByHand, Merged, merge_row
from cucumbervision.rounds.row_fruit import CountEstimate, count_fruit
from cucumbervision.rounds.row_views import RowViews
from cucumbervision_lab.simulation import SimulatedRow, Walk, simulate_row

ROW = SimulatedRow(fruit=200, sides=2, missed=0.05, false=0.02, operator_sd_m=0.03)


@dataclass(eq=False)
class Looked:
    """A row as somebody looks through it: `there` are the views that were not rejected."""

    row: Walk
    there: NDArray[np.int64]
    accepted: NDArray[np.bool_]
    same: list[tuple[int, int]]

    def count(self) -> tuple[Merged, CountEstimate]:
        """Merge and count the row with all answers so far."""
        views = self.row.views
        taken = {name: getattr(views, name)[self.there] for name in vars(views)}
        at = {view: k for k, view in enumerate(self.there.tolist())}
        pairs = [(at[a], at[b]) for a, b in self.same]
        own = RowViews(**taken)
        by_hand = ByHand(same=np.array(pairs, np.int64).reshape(-1, 2))
        merged = merge_row(self.row.stops, own, by_hand=by_hand)
        return merged, count_fruit(merged, self.row.stops, own, self.accepted[self.there])

    def tap(self, merged: Merged, fruit: int) -> None:
        """Answer what a fruit is, as somebody who sees its pictures would."""
        own = self.there[merged.cluster == fruit]
        true = int(self.row.of_fruit[own[0]])
        if true < 0:
            self.there = np.setdiff1d(self.there, own)
            return
        others = self.there[(self.row.of_fruit[self.there] == true) & (merged.cluster != fruit)]
        if len(others):
            self.same.append((int(own[0]), int(others[0])))
        self.accepted[own] = True


def looked(row: Walk) -> Looked:
    """Return a row that nobody has looked at."""
    size = len(row.views)
    return Looked(row, np.arange(size), np.zeros(size, bool), [])


def day(seed: int, taps: int) -> tuple[int, float, tuple[int, int], float]:
    """Return the truth, the count and its interval without a tap, and the count after them."""
    rows = [looked(simulate_row(ROW, 100 * seed + k)) for k in range(2)]
    truth = sum(one.row.in_view for one in rows)
    found = [one.count() for one in rows]
    before = sum(count.expected for _, count in found)
    ends = [count.interval() for _, count in found]
    middle = [(low + high) / 2 for low, high in ends]
    reach = math.hypot(*((high - low) / 2 for low, high in ends))
    interval = round(sum(middle) - reach), round(sum(middle) + reach)
    for _ in range(taps):
        doubts = [count.doubt() for _, count in found]
        k = int(np.argmax([d.max(initial=0.0) for d in doubts]))
        if doubts[k].max(initial=0.0) < 0.05:
            break
        rows[k].tap(found[k][0], int(doubts[k].argmax()))
        found[k] = rows[k].count()
    return truth, before, interval, sum(count.expected for _, count in found)


def main() -> None:
    """Print a line a day, and how many are within 2 and 4 %."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--taps", type=int, default=20)
    chosen = parser.parse_args()
    errors, inside = [], 0
    for seed in range(chosen.seeds):
        truth, before, (low, high), after = day(seed, chosen.taps)
        inside += low <= truth <= high
        errors.append((abs(before / truth - 1), abs(after / truth - 1)))
        counted = f"counted {before:.1f} ({low} to {high}), after taps {after:.1f}"
        print(f"day {seed}: {truth} fruit, {counted}")
    first, last = 100 * np.array(errors).T
    of = f"of {len(errors)} days"
    print(f"without a tap within 4 %: {(first < 4).sum()} {of}, worst {first.max():.1f} %")
    taps = f"after {chosen.taps} taps"
    print(f"{taps} within 2 %: {(last < 2).sum()} {of}, worst {last.max():.1f} %")
    print(f"truth within the 90 % interval: {inside} {of}")


if __name__ == "__main__":
    main()
