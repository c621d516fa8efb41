"""How well views are merged into fruit, fruit counted, and fruit linked between days.

    OMP_NUM_THREADS=1 python -m benchmarks.round_merging --rows 20
    python -m benchmarks.round_merging --captures FOLDER

Rows are simulated (`tests/simulated_rows.py`). Precision and recall are of pairs of
views: of the pairs that were merged, how many are one fruit, and the reverse; of the links between
days, of the sure ones. Intervals are 95 %, from resampling rows.

FOLDER holds `on_plant/` and `intrinsics.json` of a real D435. Its captures are a row with a stop
every metre, and two days later the same with the camera moved and everything as much larger.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tests.simulated_rows import SimulatedRow, Walk, grow_plants, simulate_row, walk

from cucumbervision.capture.source import ReadOptions
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs
from cucumbervision_greenhouse.rounds.day_linking import DayLinks, link_days
from cucumbervision_greenhouse.rounds.merge import Merged, cluster_pairs, merge_row
from cucumbervision_greenhouse.rounds.row_views import RowFruit, row_fruit
from cucumbervision_greenhouse.store.records import SURE

CASES = {
    "8 a metre": SimulatedRow(per_m=8),
    "10 a metre": SimulatedRow(per_m=10),
    "12 a metre": SimulatedRow(per_m=12),
    "14 a metre": SimulatedRow(per_m=14),
    "operator 6 cm": SimulatedRow(operator_sd_m=0.06),
    "all of it": SimulatedRow(
        per_m=14, operator_sd_m=0.06, missed=0.10, hidden=0.4, place_sd_m=0.01, length_sd=0.03
    ),
    "both aisles": SimulatedRow(sides=2),
}
DAYS = {
    "1 day, 8 a metre": (1.0, SimulatedRow(per_m=8), 0.03, 0.03),
    "3 days, 10 a metre": (3.0, SimulatedRow(per_m=10), 0.03, 0.03),
    **{
        f"2 days, {cm} cm a day, error 5 cm": (
            2.0,
            SimulatedRow(operator_sd_m=0.05),
            0.03,
            cm / 100,
        )
        for cm in (0, 1.5, 3, 5)
    },
    "2 days, swing 6 cm": (2.0, SimulatedRow(per_m=10), 0.06, 0.03),
}


def codes(cluster: NDArray[np.integer]) -> set[int]:
    """Return the pairs of views of one fruit as numbers."""
    i, j = cluster_pairs(np.unique(cluster, return_inverse=True)[1])
    return set((i * len(cluster) + j).tolist())


def truth(row: Walk) -> NDArray[np.int64]:
    """Return each view's true fruit; an invented one is a fruit of its own."""
    invented = row.of_fruit < 0
    return np.where(invented, 10**6 + np.arange(len(invented)), row.of_fruit)


def shares(measured: set[int], truth: set[int]) -> tuple[float, float]:
    """Return precision and recall."""
    hits = len(measured & truth)
    return hits / max(len(measured), 1), hits / max(len(truth), 1)


def merged_quality(row: Walk, merged: Merged) -> tuple[float, ...]:
    """Return precision, recall, and the relative error of the number found."""
    count_error = (int(merged.cluster.max()) + 1) / row.in_view - 1
    return *shares(codes(merged.cluster), codes(truth(row))), count_error


def linked(
    days: float, settings: SimulatedRow, swing_m: float, growth_m: float, seed: int
) -> NDArray[np.float64]:
    """Return precision and recall of links, of the sure ones, and calibration of probabilities."""
    first = simulate_row(settings, seed)
    rng = np.random.default_rng([13, seed])
    # Lowered by 15 to 35 cm, moved along by up to 40; from a point on otherwise.
    shift = np.array([rng.uniform(-0.4, 0.4), rng.uniform(-0.35, -0.15), 0.0])
    jump = np.append(rng.normal(0, 0.08, 2), 0.0)
    along = first.plants.place_m[:, :1]
    field = shift + np.where(along > rng.uniform(0.3, 0.7) * along.max(), jump, 0.0)
    plants = grow_plants(first.plants, days, field, rng, swing_m=swing_m, growth_m=growth_m)
    # The camera is lowered too, and what has left its view cannot be linked.
    plants = replace(plants, place_m=plants.place_m - [0.0, shift[1], 0.0])
    second = walk(plants, settings, rng)
    rows = [first, second]
    merged = [merge_row(row.stops, row.views) for row in rows]
    fruit = [row_fruit(m.cluster, m.stops, row.views) for m, row in zip(merged, rows, strict=True)]
    links: DayLinks = link_days(fruit[0], fruit[1], days)
    names = [row.of_fruit[f.best] for row, f in zip(rows, fruit, strict=True)]
    right = names[0][links.pairs[:, 0]] == names[1][links.pairs[:, 1]]
    right &= names[0][links.pairs[:, 0]] >= 0
    in_both = len(set(names[0][names[0] >= 0]) & set(names[1][names[1] >= 0]))
    sure = links.probability >= SURE
    return np.array(
        [
            right[sure].mean() if sure.any() else np.nan,
            right[sure].sum() / in_both,
            links.probability.mean() - right.mean(),
        ]
    )


def real_links(folder: Path) -> None:
    """Print of real fruit how many are linked rightly and wrongly, for sure."""
    options = MeasureOptions(reading=ReadOptions(intrinsics=folder / "intrinsics.json"))
    with tempfile.TemporaryDirectory() as out:
        rows = measure_inputs([folder / "on_plant"], Path(out), options).rows
    table, stops = [], list(dict.fromkeys(row["capture"] for row in rows))
    for row in (row for row in rows if row["length_cm"] and row["stem_x_m"] is not None):
        ends = [
            [float(str(row[f"{end}_{axis}_m"])) for axis in "xyz"] for end in ("stem", "blossom")
        ]
        x, y, z = np.mean(ends, axis=0)
        low, high = row["interval_low_cm"], row["interval_high_cm"]
        sd = np.log(float(str(high)) / float(str(low))) / 3.29 if low and high else 0.08
        partial = row["at_least"] or float(str(row["hidden_share"] or 0)) > 0.1
        table.append(
            (stops.index(row["capture"]), x, -y, z, float(str(row["length_cm"])), sd, partial)
        )
    fruit = np.array(table, np.float64)
    print("| fruit | grown by | moved by 0, 4, 8 cm: right / wrong |\n|--:|--:|--:|")
    for count in (9, 12):
        for share in (1.0, 1.06, 1.12, 1.25):
            counts = []
            for moved_m in (0.0, 0.04, 0.08):
                before, after = (
                    row_at(fruit[:count], 1.0, 0.0),
                    row_at(fruit[:count], share, moved_m),
                )
                links = link_days(before, after, 2.0)
                right = (links.pairs[:, 0] == links.pairs[:, 1])[links.probability >= SURE]
                counts.append(f"{right.sum()} / {(~right).sum()}")
            print(f"| {count} | {share} | {', '.join(counts)} |")


def row_at(fruit: NDArray[np.float64], share: float, moved_m: float) -> RowFruit:
    """Return fruit as a row with a stop every metre, its camera moved and all as much larger."""
    place = fruit[:, 1:4] * share + np.outer(fruit[:, 0], [1, 0, 0]) - [moved_m, 0, 0]
    errors = np.tile([0.03, 0.006, 0.008], (len(fruit), 1))
    lengths = fruit[:, 4] * share / 100, np.maximum(fruit[:, 5], 0.01)
    return RowFruit(np.arange(len(fruit)), place, errors, *lengths, fruit[:, 6] > 0)


def interval(values: NDArray[np.float64]) -> str:
    """Return mean and bootstrap interval of rows."""
    rng = np.random.default_rng(0)
    values = values[np.isfinite(values)]
    means = values[rng.integers(0, len(values), (2000, len(values)))].mean(axis=1)
    lower, upper = np.quantile(means, [0.025, 0.975])
    return f"{values.mean():7.4f} [{lower:.4f}, {upper:.4f}]"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=20, help="rows of each case")
    parser.add_argument("--captures", type=Path, help="folder of real captures")
    options = parser.parse_args()
    if options.captures:
        real_links(options.captures)
        return
    rows = options.rows
    for name, settings in CASES.items():
        walks = [simulate_row(settings, seed) for seed in range(rows)]
        table = np.array([merged_quality(row, merge_row(row.stops, row.views)) for row in walks])
        print(f"\n{name}")
        for k, head in enumerate(("precision", "recall", "count error")):
            print(f"  {head:24}{interval(table[:, k])}")
    for name, (days, settings, swing_m, growth_m) in DAYS.items():
        table = np.array([linked(days, settings, swing_m, growth_m, seed) for seed in range(rows)])
        print(f"\nlinks, {name}")
        for k, head in enumerate(("precision", "recall", "mean p - precision")):
            print(f"  {head:24}{interval(table[:, k])}")


if __name__ == "__main__":
    main()
