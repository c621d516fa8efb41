from __future__ import annotations

import numpy as np
import pytest
from tests.simulated_rows import SimulatedRow, grow_plants, simulate_row, walk

from cucumbervision_greenhouse.rounds.day_linking import DayLinks, link_days
from cucumbervision_greenhouse.rounds.merge import merge_row
from cucumbervision_greenhouse.rounds.row_views import RowFruit, row_fruit
from cucumbervision_greenhouse.store.records import SURE

ROW = SimulatedRow(per_m=10)


def linked(seed: int, along: float, up: float) -> tuple[DayLinks, float, float]:
    """Return links, and precision and recall of the sure ones."""
    first = simulate_row(ROW, seed)
    rng = np.random.default_rng(seed)
    shift = np.tile([along, up, 0.0], (len(first.plants.name), 1))
    shift[first.plants.place_m[:, 0] > 12.0, 0] += 0.12
    second = walk(grow_plants(first.plants, 1.0, shift, rng), ROW, rng)
    rows = (first, second)
    merged = [merge_row(row.stops, row.views) for row in rows]
    fruit = [row_fruit(m.cluster, m.stops, row.views) for m, row in zip(merged, rows, strict=True)]
    links = link_days(fruit[0], fruit[1], 1.0)
    names = [row.of_fruit[f.best] for row, f in zip(rows, fruit, strict=True)]
    right = names[0][links.pairs[:, 0]] == names[1][links.pairs[:, 1]]
    right &= names[0][links.pairs[:, 0]] >= 0
    both = len(set(names[0][names[0] >= 0]) & set(names[1][names[1] >= 0]))
    sure = links.probability >= SURE
    return links, right[sure].mean(), right[sure].sum() / both


def test_links_of_a_row_that_was_moved() -> None:
    found = [linked(seed, 0.35, -0.1) for seed in range(3)]
    precision, recall = np.mean([one[1:] for one in found], axis=0)
    assert precision > 0.98
    assert recall > 0.85
    shift = np.median([one[0].shift_m[0] for one in found], axis=0)
    assert shift[:2] == pytest.approx([0.35, -0.1], abs=0.03)


def test_a_jump_along_the_row_is_found() -> None:
    links = linked(1, -0.2, 0.0)[0]
    assert links.shift_m[0, 0] == pytest.approx(-0.2, abs=0.03)
    assert links.shift_m[-1, 0] == pytest.approx(-0.08, abs=0.03)


def row_of(along: list[float], lengths: list[float]) -> RowFruit:
    n = len(along)
    place = np.stack([along, np.zeros(n), np.zeros(n)], axis=1)
    few = np.full(n, 0.02)
    sd = np.full((n, 3), 0.01)
    return RowFruit(np.arange(n), place, sd, np.array(lengths), few, np.zeros(n, bool))


def test_a_fruit_that_shrank_is_no_link() -> None:
    before = row_of([0.5, 1.1, 1.9], [0.10, 0.30, 0.15])
    after = row_of([0.5, 1.1, 1.9], [0.13, 0.12, 0.18])
    assert link_days(before, after, 1.0).pairs.tolist() == [[0, 0], [2, 2]]


def test_one_of_two_alike_is_not_sure() -> None:
    before = row_of([0.5, 1.9], [0.20, 0.10])
    after = row_of([0.48, 0.52, 1.9], [0.23, 0.23, 0.13])
    links = link_days(before, after, 1.0)
    doubtful = links.pairs[:, 0] == 0
    assert (links.probability[doubtful] < 0.6).all()


@pytest.mark.parametrize("moved_m", [0.0, 0.08])
@pytest.mark.parametrize("share", [1.0, 1.06, 1.12, 1.25])
def test_place_decides_whatever_the_growth(share: float, moved_m: float) -> None:
    before = row_of([0.1, 0.3, 1.2, 2.1, 2.25, 3.0], [0.17, 0.12, 0.16, 0.27, 0.15, 0.20])
    after = row_of(
        [x + moved_m for x in before.place_m[:, 0]], [share * x for x in before.length_m]
    )
    links = link_days(before, after, 2.0)
    assert links.pairs.tolist() == [[k, k] for k in range(6)]
    assert (links.probability > SURE).all()


def test_days_must_pass() -> None:
    with pytest.raises(ValueError, match="0 days after"):
        link_days(row_of([0.5], [0.2]), row_of([0.5], [0.2]), 0)
