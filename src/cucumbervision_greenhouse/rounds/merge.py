"""Find which views of a row show the same fruit, alternating assignment and stop positions."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from cucumbervision.methods.matching import ALONG, DEPTH, Crowd, position_ratio
from cucumbervision_greenhouse.rounds import row_views
from cucumbervision_greenhouse.rounds.row_views import Floats, Ints, RowStops, RowViews

_LEAST_RATIO = -8.0  # log likelihood ratio of a pair that is no candidate


def sweep(views: RowViews, i: Ints, j: Ints, ratio: Floats, cluster: Ints) -> Ints:
    """Assign the views of each capture in turn to the fruit that the other captures show.

    One to one, by the least sum of costs (`scipy.optimize.linear_sum_assignment`; Crouse 2016).
    What a view costs at a fruit is minus the mean log ratio with that fruit's views; to be a fruit
    of its own costs nothing.

    Parameters
    ----------
    views : RowViews
        The detections.
    i, j : ndarray of intp, shape (K,)
        Pairs that may be one fruit.
    ratio : ndarray of float64, shape (K,)
        Their log likelihood ratios.
    cluster : ndarray of intp, shape (N,)
        Each view's fruit.

    Returns
    -------
    ndarray of intp, shape (N,)
        Each view's fruit, from now on.
    """
    cluster = cluster.copy()
    end = np.concatenate([i, j])
    partner = np.concatenate([j, i])
    end_ratio = np.concatenate([ratio, ratio])
    order = np.argsort(end, kind="stable")
    end, partner, end_ratio = end[order], partner[order], end_ratio[order]
    starts = np.searchsorted(end, np.arange(len(views) + 1))
    sizes = np.bincount(cluster, minlength=len(views)).astype(np.intp)
    free = np.flatnonzero(sizes == 0).tolist()
    for capture in np.unique(views.capture).tolist():
        capture_views = np.flatnonzero(views.capture == capture)
        np.subtract.at(sizes, cluster[capture_views], 1)
        picked = np.concatenate(
            [np.arange(starts[k], starts[k + 1]) for k in capture_views.tolist()]
        )
        target = cluster[partner[picked]]
        candidates, column = np.unique(target, return_inverse=True)
        row = np.searchsorted(capture_views, end[picked])
        fruit_columns = _assign(capture_views, row, column, end_ratio[picked], sizes[candidates])
        emptied = [int(c) for c in cluster[capture_views] if sizes[c] == 0]
        for k, fruit_column in zip(capture_views.tolist(), fruit_columns.tolist(), strict=True):
            if fruit_column >= 0:
                cluster[k] = candidates[fruit_column]
            else:
                cluster[k] = emptied.pop() if emptied else free.pop()
        free += emptied
        np.add.at(sizes, cluster[capture_views], 1)
    return cluster


def _assign(capture_views: Ints, row: Ints, column: Ints, ratio: Floats, sizes: Ints) -> Ints:
    """Return for each of a capture's views the column of its fruit, or -1."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = len(capture_views), len(sizes)
    if not columns:
        return np.full(rows, -1)
    total, count = np.zeros((rows, columns)), np.zeros((rows, columns))
    np.add.at(total, (row, column), ratio)
    np.add.at(count, (row, column), 1)
    mean = (total + _LEAST_RATIO * (sizes - count)) / np.maximum(sizes, 1)
    mean[:, sizes == 0] = -1e6
    # A column of its own for each view: to be no known fruit costs nothing.
    cost = np.hstack([-mean, np.where(np.eye(rows, dtype=bool), 0.0, 1e6)])
    _, fruit_columns = linear_sum_assignment(cost)
    return np.where(fruit_columns < columns, fruit_columns, -1).astype(np.intp)


def join_clusters(views: RowViews, i: Ints, j: Ints, ratio: Floats, cluster: Ints) -> Ints:
    """Join fruit whose views are alike on average and never of one capture, the most alike first.

    Assigning one view at a time cannot do that: of four views, two pairs may have formed.
    """
    groups = {c: np.flatnonzero(cluster == c).tolist() for c in np.unique(cluster).tolist()}
    low, high = np.minimum(cluster[i], cluster[j]), np.maximum(cluster[i], cluster[j])
    apart = low != high
    sums: dict[tuple[int, int], float] = defaultdict(float)
    for *pair, value in np.column_stack([low, high, ratio])[apart].tolist():
        sums[int(pair[0]), int(pair[1])] += value - _LEAST_RATIO
    means = {
        (a, b): value / (len(groups[a]) * len(groups[b])) + _LEAST_RATIO
        for (a, b), value in sums.items()
    }
    joined: set[int] = set()
    cluster = cluster.copy()
    for (a, b), mean in sorted(means.items(), key=lambda item: -item[1]):
        if mean <= 0:
            break
        captures = views.capture[groups[a] + groups[b]]
        if joined.isdisjoint((a, b)) and len(np.unique(captures)) == len(captures):
            cluster[groups[b]] = a
            joined |= {a, b}
    return cluster


def cluster_pairs(cluster: Ints) -> tuple[Ints, Ints]:
    """Return all pairs of views of one fruit, each once.

    Examples
    --------
    >>> i, j = cluster_pairs(np.array([5, 2, 5, 5]))
    >>> sorted(zip(i.tolist(), j.tolist()))
    [(0, 2), (0, 3), (2, 3)]
    """
    order = np.argsort(cluster, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1)
    pairs = [pair for group in groups for pair in combinations(group.tolist(), 2)]
    i, j = np.array(pairs, np.intp).reshape(-1, 2).T
    return i, j


_GATE_SD = 4.0
_PASSES = 4  # of assignment and estimation
_SEEN_AGAIN = 0.9  # share of the captures which could show a fruit that do show it
_SEEN_ACROSS = 0.3  # the same for captures from the other aisle, where leaves hide most fruit
# Between the cameras of the two aisles, into the row: the sum of both distances to the same fruit.
_ACROSS_M, _ACROSS_SD_M = 1.4, 0.3


@dataclass(frozen=True, eq=False)
class Merged:
    """A row, merged.

    Parameters
    ----------
    cluster : ndarray of int64, shape (N,)
        Number of each view's fruit, from 0 in the order along the row.
    stops : RowStops
        The stops, as they were estimated.
    pairs : ndarray of int64, shape (K, 2)
        All pairs of views of one fruit.
    probability : ndarray of float64, shape (K,)
        How likely each pair is one fruit, by itself.
    mirrored : tuple of int
        Sides whose views fit together far better when turned round: there positions seem to
        count the other way.
    """

    cluster: Ints
    stops: RowStops
    pairs: Ints
    probability: Floats
    mirrored: tuple[int, ...] = ()


def merge_row(stops: RowStops, views: RowViews) -> Merged:
    """Merge the views of one row into fruit.

    First pairs come from shifts that are tried between each two stops (`vote_pairs`). Then the
    stops are estimated from all pairs, each capture's views are assigned again to the fruit of the
    others, and so on in turn.

    Parameters
    ----------
    stops : RowStops
        The stops of both sides.
    views : RowViews
        Their detections.

    Returns
    -------
    Merged

    Examples
    --------
    >>> at_m = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    >>> stops = RowStops(at_m, np.full((2, 3), 0.03), np.zeros(2, int), np.full(2, 0.6))
    >>> two, one = np.arange(2), np.ones(2)
    >>> offset_m = np.array([[0.2, 0.1, 0.7], [-0.2, 0.1, 0.7]])  # one fruit, seen from both
    >>> views = RowViews(two, two, offset_m, np.full((2, 3), 0.006), 0.2 * one, 0.015 * one,
    ...     0.04 * one, 0.03 * one, one < 0, 0.9 * one)
    >>> merge_row(stops, views).cluster.tolist()
    [0, 0]
    """
    if not len(views):
        nothing = np.zeros(0)
        return Merged(nothing.astype(np.int64), stops, np.zeros((0, 2), np.int64), nothing)
    crowd = row_views.crowd_of(views, _views_per_m(stops, views))
    i, j = _candidates(stops, views)
    one_side = stops.side[views.stop[i]] == stops.side[views.stop[j]]
    first, second = i[one_side], j[one_side]
    apart = views.stop[first] != views.stop[second]
    voted = row_views.vote_pairs(stops, views, first[apart], second[apart], crowd)
    mirrored = _mirrored(stops, views, crowd)
    fitted = row_views.fit_stops(stops, views, voted[0], voted[1], np.full(len(voted[0]), 0.8))
    if len(np.unique(stops.side)) > 1:
        stops = _set_across(stops, _vote_across(fitted, views, crowd))
        fitted = row_views.fit_stops(stops, views, voted[0], voted[1], np.full(len(voted[0]), 0.8))
    cluster: Ints = np.arange(len(views))
    for _ in range(_PASSES):
        i, j, ratio = _rated(fitted, views, crowd)
        cluster = sweep(views, i, j, ratio, cluster)
        cluster = sweep(views, i, j, ratio, join_clusters(views, i, j, ratio, cluster))
        a, b = cluster_pairs(cluster)
        m = np.bincount(cluster, minlength=len(views))[cluster[a]]
        fitted = row_views.fit_stops(stops, views, a, b, 2.0 / np.maximum(m, 1))
    i, j, ratio = _rated(fitted, views, crowd)
    cluster = join_clusters(views, i, j, ratio, sweep(views, i, j, ratio, cluster))
    along = fitted.at_m[views.stop, ALONG] + views.offset_m[:, ALONG]
    numbers = _numbered(cluster, along)
    pairs = np.column_stack(cluster_pairs(numbers))
    return Merged(numbers, fitted, pairs, _chance(pairs, i, j, ratio), mirrored)


def _views_per_m(stops: RowStops, views: RowViews) -> float:
    """Return how many views a capture has per metre of row that it shows."""
    captures, first_view = np.unique(views.capture, return_index=True)
    typical_depth_m = float(np.median(np.abs(views.offset_m[:, DEPTH])))
    width_m = 2 * stops.reach[views.stop[first_view]] * typical_depth_m
    return len(views) / max(float(width_m.sum()), 1e-6 * len(captures))


def _candidates(stops: RowStops, views: RowViews) -> tuple[Ints, Ints]:
    """Return pairs of views of different captures that may be one fruit, by their place alone."""
    along = stops.at_m[views.stop, ALONG] + views.offset_m[:, ALONG]
    place_sd_m = np.hypot(stops.sd_m[views.stop, ALONG], views.offset_sd_m[:, ALONG])
    i, j = row_views.pairs_within(along, _GATE_SD * np.sqrt(2) * place_sd_m)
    different_capture = views.capture[i] != views.capture[j]
    return i[different_capture], j[different_capture]


def _gaps(stops: RowStops, views: RowViews, i: Ints, j: Ints) -> tuple[Floats, Floats]:
    """Return how far views j are from views i, shape (K, 3), and the variance of that."""
    s, t = views.stop[i], views.stop[j]
    gap = stops.at_m[t] + views.offset_m[j] - stops.at_m[s] - views.offset_m[i]
    variance = views.offset_sd_m[i] ** 2 + views.offset_sd_m[j] ** 2 + stops.gap_variance(s, t)
    return gap, variance


def _rated(stops: RowStops, views: RowViews, crowd: Crowd) -> tuple[Ints, Ints, Floats]:
    """Return the candidates and their log likelihood ratios."""
    i, j = _candidates(stops, views)
    gap, variance = _gaps(stops, views, i, j)
    ratio = position_ratio(gap, variance, crowd) + row_views.shape_ratio(views, i, j, crowd)
    across = stops.side[views.stop[i]] != stops.side[views.stop[j]]
    return i, j, ratio + np.log(np.where(across, _SEEN_ACROSS, _SEEN_AGAIN))


def _vote_across(stops: RowStops, views: RowViews, crowd: Crowd) -> tuple[float, float]:
    """Estimate how far apart the two aisles' cameras are, from pairs alike in all but depth."""
    i, j = _candidates(stops, views)
    across = stops.side[views.stop[i]] != stops.side[views.stop[j]]
    i, j = i[across], j[across]
    gap, variance = _gaps(stops, views, i, j)
    distance_m = np.abs(gap[:, DEPTH])
    gap, depth_variance = gap * [1.0, 1.0, 0.0], variance[:, DEPTH]
    ratio = position_ratio(gap, variance, crowd) + row_views.shape_ratio(views, i, j, crowd)
    tried = _ACROSS_M + _ACROSS_SD_M * np.linspace(-3, 3, 121)
    fit = -0.5 * (distance_m[:, None] - tried) ** 2 / depth_variance[:, None]
    score = np.log1p(np.exp(np.minimum(ratio[:, None] + fit, 20.0))).sum(axis=0)
    score -= 0.5 * ((tried - _ACROSS_M) / _ACROSS_SD_M) ** 2
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    middle = float(weight @ tried)
    return middle, float(np.sqrt(weight @ (tried - middle) ** 2))


def _set_across(stops: RowStops, across: tuple[float, float]) -> RowStops:
    opposite = stops.side == 1
    at_m, sd_m = stops.at_m.copy(), stops.sd_m.copy()
    at_m[opposite, DEPTH] += across[0]
    sd_m[opposite, DEPTH] = np.hypot(sd_m[opposite, DEPTH], across[1])
    return replace(stops, at_m=at_m, sd_m=sd_m)


def _mirrored(stops: RowStops, views: RowViews, crowd: Crowd) -> tuple[int, ...]:
    """Return the sides whose views agree far better if their offsets are mirrored."""
    sides = []
    for side in np.unique(stops.side).tolist():
        support = []
        for sign in (1.0, -1.0):
            turned = replace(views, offset_m=views.offset_m * [sign, 1.0, 1.0])
            i, j = _candidates(stops, turned)
            s, t = views.stop[i], views.stop[j]
            of_side = (stops.side[s] == side) & (stops.side[t] == side) & (s != t)
            support.append(row_views.vote_pairs(stops, turned, i[of_side], j[of_side], crowd)[2])
        if support[1] > 2 * max(support[0], 0.0) + 20:
            sides.append(int(side))
    return tuple(sides)


def _numbered(cluster: Ints, along: Floats) -> Ints:
    """Return the clusters numbered along the row, from 0."""
    _, name_index = np.unique(cluster, return_inverse=True)
    middle = np.bincount(name_index, along) / np.bincount(name_index)
    return np.argsort(np.argsort(middle, kind="stable"))[name_index]


def _chance(pairs: Ints, i: Ints, j: Ints, ratio: Floats) -> Floats:
    """Return the probability that each pair is one fruit; 0.5 where a pair was not rated."""
    rated = dict(zip(zip(i.tolist(), j.tolist(), strict=True), ratio.tolist(), strict=True))
    value = np.array([rated.get((a, b), 0.0) for a, b in pairs.tolist()], np.float64)
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(value, -30, 30))), np.float64)
