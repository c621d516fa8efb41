"""How well views are merged into fruit, fruit counted, and fruit linked between days.

    OMP_NUM_THREADS=1 python -m benchmarks.round_merging --rows 20

Rows are simulated (`tests/simulated_rows.py`). Precision and recall are of pairs of
views: of the pairs that were merged, how many are one fruit, and the reverse. Beside it stands what
position alone does: views of neighbouring stops nearer to each other than three standard
deviations, one to one. Intervals are 95 %, from resampling rows.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from tests.simulated_rows import SimulatedRow, Walk, grow_plants, simulate_row, walk

from cucumbervision_greenhouse.rounds.day_linking import DayLinks, link_days
from cucumbervision_greenhouse.rounds.merge import Merged, cluster_pairs, merge_row
from cucumbervision_greenhouse.rounds.row_views import row_fruit

UPRIGHT = {"reach": (0.384, 0.687), "band_m": 0.8}
CASES = {
    "8 a metre": SimulatedRow(per_m=8),
    "10 a metre": SimulatedRow(per_m=10),
    "12 a metre": SimulatedRow(per_m=12),
    "14 a metre": SimulatedRow(per_m=14),
    "operator 6 cm": SimulatedRow(operator_sd_m=0.06),
    "10 % missed": SimulatedRow(missed=0.10),
    "half hidden in part": SimulatedRow(hidden=0.5),
    "places 1 cm": SimulatedRow(place_sd_m=0.01),
    "lengths 5 %": SimulatedRow(length_sd=0.05),
    "all of it": SimulatedRow(
        per_m=14, operator_sd_m=0.06, missed=0.10, hidden=0.4, place_sd_m=0.01, length_sd=0.03
    ),
    "upright camera": SimulatedRow(per_m=10, **UPRIGHT),  # type: ignore[arg-type]
    "both aisles": SimulatedRow(sides=2),
    "both aisles, all": SimulatedRow(
        sides=2, per_m=14, operator_sd_m=0.06, missed=0.10, hidden=0.4, place_sd_m=0.01
    ),
}
DAYS = {
    "1 day, 8 a metre": (1.0, SimulatedRow(per_m=8), 0.03),
    "1 day, 12 a metre": (1.0, SimulatedRow(per_m=12), 0.03),
    "2 days, 10 a metre": (2.0, SimulatedRow(per_m=10), 0.03),
    "3 days, 10 a metre": (3.0, SimulatedRow(per_m=10), 0.03),
    "2 days, swing 6 cm": (2.0, SimulatedRow(per_m=10), 0.06),
    "2 days, upright camera": (2.0, SimulatedRow(per_m=10, **UPRIGHT), 0.03),  # type: ignore[arg-type]
}


@dataclass(frozen=True)
class Quality:
    """Precision, recall, relative error of the number found; the same by position only."""

    precision: float
    recall: float
    count_error: float
    naive_precision: float
    naive_recall: float
    naive_count_error: float
    stop_error_m: float


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


def by_position(row: Walk) -> NDArray[np.int64]:
    """Merge by position alone: each capture one to one with the fruit so far, within 3 sd."""
    views, stops = row.views, row.stops
    along = stops.at_m[views.stop, 0] + views.offset_m[:, 0]
    cluster = np.full(len(views), -1)
    last: NDArray[np.float64] = np.zeros(0)
    gate = 3 * np.sqrt(2) * float(stops.sd_m[0, 0])
    for capture in np.unique(views.capture):
        readings = np.flatnonzero(views.capture == capture)
        gap = np.abs(along[readings][:, None] - last)
        a, b = linear_sum_assignment(np.minimum(gap, gate))
        is_near = gap[a, b] < gate
        cluster[readings[a[is_near]]] = b[is_near]
        new = readings[cluster[readings] < 0]
        cluster[new] = len(last) + np.arange(len(new))
        last = np.append(last, along[new])
    return cluster


def merged_quality(row: Walk, merged: Merged) -> Quality:
    """Hold a merged row against its truth."""
    true_codes = codes(truth(row))
    naive = by_position(row)
    return Quality(
        *shares(codes(merged.cluster), true_codes),
        (int(merged.cluster.max()) + 1) / row.in_view - 1,
        *shares(codes(naive), true_codes),
        (int(naive.max()) + 1) / row.in_view - 1,
        float(merged.stops.sd_m[:, 0].mean()),
    )


def linked(days: float, settings: SimulatedRow, swing_m: float, seed: int) -> NDArray[np.float64]:
    """Return precision and recall of links, of the sure ones, and calibration of probabilities."""
    first = simulate_row(settings, seed)
    rng = np.random.default_rng([13, seed])
    # Lowered by 15 to 35 cm, moved along by up to 40; from a point on otherwise.
    shift = np.array([rng.uniform(-0.4, 0.4), rng.uniform(-0.35, -0.15), 0.0])
    jump = np.append(rng.normal(0, 0.08, 2), 0.0)
    along = first.plants.place_m[:, :1]
    field = shift + np.where(along > rng.uniform(0.3, 0.7) * along.max(), jump, 0.0)
    plants = grow_plants(first.plants, days, field, rng, swing_m=swing_m)
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
    sure = links.sure
    return np.array(
        [
            right.mean(),
            right.sum() / in_both,
            right[sure].mean() if sure.any() else np.nan,
            right[sure].sum() / in_both,
            links.probability.mean() - right.mean(),
        ]
    )


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
    rows = parser.parse_args().rows
    for name, settings in CASES.items():
        qualities = []
        for seed in range(rows):
            row = simulate_row(settings, seed)
            qualities.append(merged_quality(row, merge_row(row.stops, row.views)))
        table = np.array([list(vars(quality).values()) for quality in qualities])
        heads = ("precision", "recall", "count error", "by position: precision", "recall")
        print(f"\n{name}")
        for k, head in enumerate((*heads, "count error")):
            print(f"  {head:24}{interval(table[:, k])}")
        errors = table[:, 2]
        print(
            f"  count: sd {errors.std():.4f}, within 1 % {np.mean(np.abs(errors) <= 0.01):.2f}; "
            f"stops known to {100 * table[:, 6].mean():.1f} cm"
        )
    for name, (days, settings, swing_m) in DAYS.items():
        table = np.array([linked(days, settings, swing_m, seed) for seed in range(rows)])
        print(f"\nlinks, {name}")
        of_links = ("precision", "recall", "sure: precision", "sure: recall", "mean p - precision")
        for k, head in enumerate(of_links):
            print(f"  {head:24}{interval(table[:, k])}")


if __name__ == "__main__":
    main()
