from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_greenhouse.rounds.merge import NO_PAIRS, Merged
from cucumbervision_greenhouse.rounds.row_fruit import (
    CountEstimate,
    count_fruit,
    estimate_count,
    found_share,
    row_fruit,
    times_shown,
)
from cucumbervision_greenhouse.rounds.row_views import RowStops, RowViews
from cucumbervision_greenhouse.rounds.stop_alignment import prior_stops


def test_captures_that_could_show_a_fruit() -> None:
    # Cameras at 0, 0.4 and 0.8 m see 0.7 tan = 0.35 m to either side, less 3 cm of margin.
    at_m = np.zeros((3, 3))
    at_m[:, 0] = 0.0, 0.4, 0.8
    stops = RowStops(at_m, np.full((3, 3), 0.03), np.zeros(3, int), np.full((3, 2), 0.5))
    # One fruit at 0.2 m, seen by the first two; one at 0.35 m, seen by the second alone.
    offset = np.array([[0.2, 0, 0.7], [-0.2, 0, 0.7], [-0.05, 0, 0.7], [0.5, 0.0, 0.7]])
    ones = np.ones(4)
    stop = np.array([0, 1, 1, 2])
    views = RowViews(
        stop, stop, offset, np.full((4, 3), 0.01), ones, ones, ones, ones, ones > 2, ones, ones
    )
    cluster = np.array([0, 0, 1, 2])
    merged = Merged(cluster, prior_stops(stops), NO_PAIRS, np.zeros(0))
    assert times_shown(merged, stops, views).tolist() == [2, 1, 0]


@pytest.mark.parametrize("again", [0, 3, 8])
def test_pictures_that_show_nothing_again_are_only_counted(again: int) -> None:
    """Twenty pictures from nearly one place, of one fruit each: they should all show all."""
    at_m = np.zeros((20, 3))
    at_m[:, 0] = 0.005 * np.arange(20)
    stops = RowStops(at_m, np.full((20, 3), 0.03), np.zeros(20, int), np.full((20, 2), 0.5))
    offset, ones, at = np.tile([0.0, 0.0, 0.7], (20, 1)), np.ones(20), np.arange(20)
    views = RowViews(
        at, at, offset, np.full((20, 3), 0.01), ones, ones, ones, ones, ones > 2, ones, ones
    )
    cluster = np.maximum(at - again, 0)  # so many were taken for the first fruit
    merged = Merged(cluster, prior_stops(stops), NO_PAIRS, np.zeros(0))
    count = count_fruit(merged, stops, views)
    assert (count.expected, count.sd, count.interval()) == (20 - again, 0.0, (20 - again,) * 2)
    assert found_share([count]) == (1.0, 0.0, 0.0)


def test_a_fruit_is_as_long_as_its_whole_views_say_together() -> None:
    # The first fruit: whole views of 0.30 and 0.31 m, equally sure, and a lower bound; the second
    # is only seen in part, by the surer of two; the third was not measured.
    stops = RowStops(np.zeros((1, 3)), np.full((1, 3), 0.03), np.zeros(1, int), np.ones((1, 2)))
    length_m = np.array([0.30, 0.31, 0.20, 0.15, 0.18, np.nan])
    length_sd = np.array([0.05, 0.05, 0.05, 0.10, 0.02, np.nan])
    cluster, partial = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 0, 1, 1, 1, 0], bool)
    at, ones, offset_m = np.zeros(6, int), np.ones(6), np.ones((6, 3))
    views = RowViews(
        at, at, offset_m, offset_m, length_m, length_sd, ones, ones, partial, ones, ones
    )
    found = row_fruit(Merged(cluster, prior_stops(stops), NO_PAIRS, np.zeros(0)), views)
    assert found.partial.tolist() == [False, True, False]
    assert found.length_m == pytest.approx([(0.30 * 0.31) ** 0.5, 0.18, np.nan], nan_ok=True)
    # Half of the variance is shared by all views: 0.05^2 (1/2 + 1/4).
    assert found.length_sd == pytest.approx([0.05 * 0.75**0.5, 0.02, np.nan], nan_ok=True)


def test_nothing_found_is_nothing() -> None:
    none = np.zeros(0, np.int64)
    found = estimate_count(none, none, np.zeros(0), np.zeros(0))
    assert (found.expected, found.sd) == (0.0, 0.0)


@pytest.mark.parametrize("q", [0.6, 0.95])
def test_share_seen_again_is_learnt(q: float) -> None:
    rng = np.random.default_rng(1)
    seen = rng.binomial(3, q, 4000)
    seen = np.append(seen[seen > 0], np.ones(100, int))  # and a hundred that are invented
    score = np.full(len(seen), 0.8)
    found = estimate_count(seen, np.full(len(seen), 3), score, np.zeros(0))
    assert found.seen_again == pytest.approx(q, abs=0.02)
    assert found.expected == pytest.approx(4000, abs=4 * found.sd)
    assert found.sd < 100


def test_share_found_by_hand() -> None:
    # Nine fruit and one invented, two captures each, q = 0.5: of a pair of which something is
    # seen, one view is 2/3 and two are 1/3 likely, so that their number has the variance 2/9.
    # Information of q: 20 / 0.25 before, and 9 (2/9) / 0.25^2 = 32 from the views: 112.
    # Expected are 9 / (1 - 0.25) = 12 fruit, which fall by 9 (2 * 0.5) / 0.75^2 = 16 for each q.
    real = np.append(np.ones(9), 0.0)
    twos = np.full(10, 2)
    count = CountEstimate(12.0, 0.0, twos, twos, real, 0.5)
    assert count.expected_variance() == pytest.approx(16**2 / 112)
    assert found_share([count]) == pytest.approx((0.75, 0.75 * 16 / 112**0.5 / 12, 0.1))
    # Another row like it: twice the variance of twice the sum.
    found, sd, false = found_share([count, count])
    assert (found, false) == pytest.approx((0.75, 0.1))
    assert sd == pytest.approx(0.75 * 16 / 112**0.5 / 12 / 2**0.5)


def test_without_any_row_the_priors_stand() -> None:
    assert found_share([]) == pytest.approx((0.9, (0.9 * 0.1 / 20) ** 0.5, 0.02))
    assert found_share([CountEstimate.of_nothing()]) == found_share([])


def test_a_count_that_stands_still_is_that_of_all_iterations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(4)
    chances = np.full(60, 3)
    views = np.maximum(rng.binomial(chances, 0.6), 1)
    scores = rng.uniform(0.3, 0.9, 60)
    settled = estimate_count(views, chances, scores, np.zeros(0))
    monkeypatch.setattr("cucumbervision_greenhouse.rounds.row_fruit._STILL", 0.0)
    every = estimate_count(views, chances, scores, np.zeros(0))
    assert settled.expected == pytest.approx(every.expected, rel=1e-6)
    assert settled.sd == pytest.approx(every.sd, rel=1e-6)
    assert settled.real == pytest.approx(every.real, abs=1e-6)
