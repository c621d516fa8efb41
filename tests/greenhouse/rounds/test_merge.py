from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.simulated_rows import SimulatedRow, Walk, simulate_row

from cucumbervision_greenhouse.rounds.merge import cluster_pairs, join_clusters, merge_row, sweep
from cucumbervision_greenhouse.rounds.row_views import RowStops, RowViews, best_views, row_fruit

GIVEN = SimulatedRow(per_m=10)
HARDER = SimulatedRow(per_m=14, operator_sd_m=0.06, missed=0.10)


def pair_codes(cluster: NDArray[np.integer]) -> set[int]:
    i, j = cluster_pairs(np.unique(cluster, return_inverse=True)[1])
    return set((i * len(cluster) + j).tolist())


def shares(walk: Walk, cluster: NDArray[np.integer]) -> tuple[float, float]:
    invented = walk.of_fruit < 0
    truth = np.where(invented, 10**6 + np.arange(len(invented)), walk.of_fruit)
    found, true = pair_codes(cluster), pair_codes(truth)
    return len(found & true) / len(found), len(found & true) / len(true)


@pytest.mark.parametrize("settings", [GIVEN, replace(GIVEN, per_m=12), replace(GIVEN, sides=2)])
def test_pairs_and_counts_of_simulated_rows(settings: SimulatedRow) -> None:
    found = []
    for seed in range(3):
        walk = simulate_row(settings, seed)
        merged = merge_row(walk.stops, walk.views)
        found.append(shares(walk, merged.cluster))
    precision, recall = np.mean(found, axis=0)
    assert precision >= 0.98
    assert recall >= 0.98


@pytest.mark.parametrize("sides", [1, 2])
def test_no_fruit_twice_from_one_capture(sides: int) -> None:
    walk = simulate_row(replace(HARDER, sides=sides, fruit=80), 3)
    cluster = merge_row(walk.stops, walk.views).cluster
    both = np.column_stack([cluster, walk.views.capture])
    assert len(np.unique(both, axis=0)) == len(both)


def test_stops_are_found_better_than_they_were_given() -> None:
    rng = np.random.default_rng(4)
    walk = simulate_row(replace(GIVEN, operator_sd_m=1e-6, camera_sd_m=1e-6), 4)
    error = rng.normal(0.0, 0.03, len(walk.stops))
    given = walk.stops.at_m + np.stack([error, 0 * error, 0 * error], axis=1)
    stops = replace(walk.stops, at_m=given, sd_m=np.full(given.shape, 0.03))
    fitted = merge_row(stops, walk.views).stops
    left = fitted.at_m[:, 0] - walk.stops.at_m[:, 0]
    assert left.std() < 0.4 * error.std()
    # The errors are those that the standard deviations promise.
    assert 0.4 < np.sqrt(np.mean((left / fitted.sd_m[:, 0]) ** 2)) < 2.0


def test_distance_between_aisles_is_found() -> None:
    walk = simulate_row(replace(GIVEN, sides=2, distance_m=0.8), 1)
    into_m = merge_row(walk.stops, walk.views).stops.at_m[:, 2]
    apart_m = into_m[walk.stops.side == 1].mean() - into_m[walk.stops.side == 0].mean()
    assert apart_m == pytest.approx(1.6, abs=0.03)


def test_positions_that_count_the_other_way_are_noticed() -> None:
    walk = simulate_row(replace(GIVEN, fruit=80), 1)
    assert merge_row(walk.stops, walk.views).mirrored == ()
    turned = replace(walk.views, offset_m=walk.views.offset_m * [-1.0, 1.0, 1.0])
    assert merge_row(walk.stops, turned).mirrored == (0,)


def few_views(captures: list[int]) -> RowViews:
    n = len(captures)
    at, ones = np.array(captures), np.ones(n)
    return RowViews(
        at, at, np.zeros((n, 3)), np.ones((n, 3)), ones, ones, ones, ones, ones > 2, ones
    )


def test_sweep_takes_the_best_sum_and_not_the_best_pair() -> None:
    # Views 0, 1 of one capture, 2, 3 of the next: 0-2 is the best pair, 0-3 and 1-2 the best sum.
    i, j = np.array([0, 0, 1]), np.array([2, 3, 2])
    ratio = np.array([5.0, 4.0, 4.5])
    cluster = sweep(few_views([0, 0, 1, 1]), i, j, ratio, np.arange(4))
    assert cluster[0] == cluster[3]
    assert cluster[1] == cluster[2]
    assert cluster[0] != cluster[1]


def test_two_halves_join_but_never_two_views_of_one_capture() -> None:
    i, j = np.array([0, 0, 1, 1]), np.array([2, 3, 2, 3])
    halves = np.array([0, 0, 1, 1])
    ratio = np.full(4, 3.0)
    joined = join_clusters(few_views([0, 1, 2, 3]), i, j, ratio, halves)
    assert len(set(joined.tolist())) == 1
    barred = join_clusters(few_views([0, 1, 1, 3]), i, j, ratio, halves)
    assert len(set(barred.tolist())) == 2


def test_best_view_shows_the_whole_fruit() -> None:
    walk = simulate_row(replace(GIVEN, fruit=60, hidden=0.5), 2)
    merged = merge_row(walk.stops, walk.views)
    best = best_views(merged.cluster, walk.views)
    whole = np.zeros(len(best), bool)
    np.logical_or.at(whole, merged.cluster, ~walk.views.partial)
    assert (walk.views.partial[best] == ~whole).all()
    fruit = row_fruit(merged.cluster, merged.stops, walk.views)
    assert (np.diff(fruit.place_m[:, 0]) > -0.2).all()


def test_nothing_and_one_view() -> None:
    stops = RowStops(np.zeros((1, 3)), np.full((1, 3), 0.03), np.zeros(1, int), np.ones(1))
    one = few_views([0])
    assert merge_row(stops, one).cluster.tolist() == [0]


def test_a_fruit_is_as_long_as_its_whole_views_say_together() -> None:
    # The first fruit: whole views of 0.30 and 0.31 m, equally sure, and a lower bound; the second
    # is only seen in part, by the surer of two; the third was not measured.
    stops = RowStops(np.zeros((1, 3)), np.full((1, 3), 0.03), np.zeros(1, int), np.ones(1))
    length_m = np.array([0.30, 0.31, 0.20, 0.15, 0.18, np.nan])
    length_sd = np.array([0.05, 0.05, 0.05, 0.10, 0.02, np.nan])
    cluster, partial = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 0, 1, 1, 1, 0], bool)
    at, ones, offset_m = np.zeros(6, int), np.ones(6), np.ones((6, 3))
    views = RowViews(at, at, offset_m, offset_m, length_m, length_sd, ones, ones, partial, ones)
    found = row_fruit(cluster, stops, views)
    assert found.partial.tolist() == [False, True, False]
    assert found.length_m == pytest.approx([(0.30 * 0.31) ** 0.5, 0.18, np.nan], nan_ok=True)
    # Half of the variance is shared by all views: 0.05^2 (1/2 + 1/4).
    assert found.length_sd == pytest.approx([0.05 * 0.75**0.5, 0.02, np.nan], nan_ok=True)
