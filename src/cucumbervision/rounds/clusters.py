"""From likely pairs to fruit: each view belongs to one, and none has two views of one capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.rounds.row_views import RowViews

__all__ = ["cluster_pairs", "join_clusters", "sweep"]

UNLIKE = -8.0  # what a pair counts that is not among the likely ones
HELD = 40.0  # what a pair counts that somebody merged by hand


def sweep(
    views: RowViews,
    i: NDArray[np.intp],
    j: NDArray[np.intp],
    ratio: NDArray[np.float64],
    cluster: NDArray[np.intp],
) -> NDArray[np.intp]:
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
    of = np.concatenate([i, j])
    other = np.concatenate([j, i])
    both = np.concatenate([ratio, ratio])
    order = np.argsort(of, kind="stable")
    of, other, both = of[order], other[order], both[order]
    starts = np.searchsorted(of, np.arange(len(views) + 1))
    sizes = np.bincount(cluster, minlength=len(views)).astype(np.intp)
    members = _members(views)
    free = np.flatnonzero(sizes == 0).tolist()
    for own in members:
        np.subtract.at(sizes, cluster[own], 1)
        picked = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in own.tolist()])
        target = cluster[other[picked]]
        candidates, column = np.unique(target, return_inverse=True)
        row = np.searchsorted(own, of[picked])
        at = _assign(own, row, column, both[picked], sizes[candidates])
        left = [int(c) for c in cluster[own] if sizes[c] == 0]
        for k, found in zip(own.tolist(), at.tolist(), strict=True):
            if found >= 0:
                cluster[k] = candidates[found]
            else:
                cluster[k] = left.pop() if left else free.pop()
        free += left
        np.add.at(sizes, cluster[own], 1)
    return cluster


def _members(views: RowViews) -> list[NDArray[np.intp]]:
    order = np.argsort(views.capture, kind="stable")
    ordered = views.capture[order]
    cuts = np.flatnonzero(np.diff(ordered)) + 1
    return [np.sort(part) for part in np.split(order, cuts) if len(part)]


def _assign(
    own: NDArray[np.intp],
    row: NDArray[np.intp],
    column: NDArray[np.intp],
    ratio: NDArray[np.float64],
    sizes: NDArray[np.intp],
) -> NDArray[np.intp]:
    """Give for each of a capture's views the column of its fruit, or -1."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = len(own), len(sizes)
    if not columns:
        return np.full(rows, -1)
    total, count = np.zeros((rows, columns)), np.zeros((rows, columns))
    np.add.at(total, (row, column), ratio)
    np.add.at(count, (row, column), 1)
    mean = (total + UNLIKE * (sizes - count)) / np.maximum(sizes, 1)
    mean[:, sizes == 0] = -1e6
    # A column of its own for each view: to be no known fruit costs nothing.
    cost = np.hstack([-mean, np.where(np.eye(rows, dtype=bool), 0.0, 1e6)])
    _, at = linear_sum_assignment(cost)
    return np.where(at < columns, at, -1).astype(np.intp)


def join_clusters(
    views: RowViews,
    i: NDArray[np.intp],
    j: NDArray[np.intp],
    ratio: NDArray[np.float64],
    cluster: NDArray[np.intp],
) -> NDArray[np.intp]:
    """Join fruit whose views are alike on average and never of one capture, the likest first.

    A view at a time cannot do that: of four views, two and two may have found each other.
    """
    groups = {c: np.flatnonzero(cluster == c).tolist() for c in np.unique(cluster).tolist()}
    apart = cluster[i] != cluster[j]
    sums: dict[tuple[int, int], float] = {}
    for a, b, value in zip(
        cluster[i][apart].tolist(), cluster[j][apart].tolist(), ratio[apart].tolist(), strict=True
    ):
        key = (min(a, b), max(a, b))
        sums[key] = sums.get(key, 0.0) + value - UNLIKE
    means = {
        key: value / (len(groups[key[0]]) * len(groups[key[1]])) + UNLIKE
        for key, value in sums.items()
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


def cluster_pairs(cluster: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Give all pairs of views of one fruit, each once.

    Examples
    --------
    >>> i, j = cluster_pairs(np.array([5, 2, 5, 5]))
    >>> sorted(zip(i.tolist(), j.tolist()))
    [(0, 2), (0, 3), (2, 3)]
    """
    order = np.argsort(cluster, kind="stable")
    ordered = cluster[order]
    first, second = [], []
    for step in range(1, int(np.bincount(cluster).max()) if len(cluster) else 0):
        same = np.flatnonzero(ordered[:-step] == ordered[step:])
        first.append(order[same])
        second.append(order[same + step])
    none: NDArray[np.intp] = np.zeros(0, np.intp)
    i, j = np.concatenate([none, *first]), np.concatenate([none, *second])
    return np.minimum(i, j), np.maximum(i, j)
