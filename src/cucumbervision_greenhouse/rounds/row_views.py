"""One row as arrays: its stops, its views, and how alike the shapes of two views are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from cucumbervision.methods.matching import Crowd, pooled_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_greenhouse.rounds.merge import Merged

Floats: TypeAlias = "NDArray[np.float64]"
Ints: TypeAlias = "NDArray[np.integer]"
Bools: TypeAlias = "NDArray[np.bool_]"


@dataclass(frozen=True, eq=False)
class RowStops:
    """The S stops of one row, both sides.

    Parameters
    ----------
    at_m : ndarray of float64, shape (S, 3)
        The camera as it was given: along, up, and into the row; metres. Up and into the row
        count from the usual camera of its side, so that they are 0 unless a pose is given.
    sd_m : ndarray of float64, shape (S, 3)
        Standard deviations of these, metres.
    side : ndarray of int64, shape (S,)
        0, or 1 for stops made from the other aisle.
    reach : ndarray of float64, shape (S, 2)
        Tangents of half the field of view, along and up.
    """

    at_m: Floats
    sd_m: Floats
    side: Ints
    reach: Floats

    def __len__(self) -> int:
        """Return the number of stops."""
        return len(self.side)


@dataclass(frozen=True, eq=False)
class RowViews:
    """The N detections of a row's captures, each a view of one fruit.

    Parameters
    ----------
    stop, capture : ndarray of int64, shape (N,)
        Index of the stop, and number of the capture; one capture belongs to one stop.
    offset_m, offset_sd_m : ndarray of float64, shape (N, 3)
        The fruit's middle from the camera in the row's frame, and standard deviations, metres.
    length_m, length_sd : ndarray of float64, shape (N,)
        Length in metres, NaN where it was not measured, and its relative standard deviation.
    diameter_m, diameter_sd : ndarray of float64, shape (N,)
        Largest diameter likewise.
    partial : ndarray of bool, shape (N,)
        Whether part of the fruit is hidden or cut off: its length is a lower bound.
    score : ndarray of float64, shape (N,)
        The detector's confidence, 0 to 1.
    view_score : ndarray of float64, shape (N,)
        How well the view shows the fruit, 0 to 1.
    """

    stop: Ints
    capture: Ints
    offset_m: Floats
    offset_sd_m: Floats
    length_m: Floats
    length_sd: Floats
    diameter_m: Floats
    diameter_sd: Floats
    partial: Bools
    score: Floats
    view_score: Floats

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.stop)


def pairs_within(values: Floats, gate: float | Floats) -> tuple[Ints, Ints]:
    """Return all pairs i, j of values that lie no farther apart than a gate, each once.

    Parameters
    ----------
    values : ndarray of float64, shape (N,)
        Positions.
    gate : float or ndarray of float64, shape (N,)
        How far each looks; of two that look differently far the farther one counts.

    Returns
    -------
    i, j : ndarray of intp, shape (K,)
        Indices, i before j in the order of values.

    Examples
    --------
    >>> i, j = pairs_within(np.array([0.3, 0.0, 0.1, 0.9]), 0.25)
    >>> list(zip(i.tolist(), j.tolist()))
    [(1, 2), (2, 0)]
    """
    widest = float(np.max(gate, initial=0.0))
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    until = np.searchsorted(ordered, ordered + widest, side="right")
    counts = np.maximum(until - np.arange(len(values)) - 1, 0)
    first = np.repeat(np.arange(len(values)), counts)
    start = np.repeat(np.cumsum(counts) - counts, counts)
    second = first + 1 + np.arange(len(first)) - start
    i, j = order[first], order[second]
    if np.ndim(gate):
        reach = np.broadcast_to(gate, values.shape)
        within = np.abs(values[i] - values[j]) <= np.maximum(reach[i], reach[j])
        return i[within], j[within]
    return i, j


_SIZE_TAIL = 0.1  # share of sizes that are wrong: a hidden end, leaves measured as fruit

_SIZE_ERROR_MAX = 0.7  # largest error of their logarithm, either way

# Of the logarithm: a fruit of which less than 30 % is visible is rarely detected.
_MOST_HIDDEN = 1.2

_LONGEST_PAST = 0.02  # least noise of the logarithm of a lower bound


def crowd_of(views: RowViews, per_m: float) -> Crowd:
    """Return the crowd of a row's own views, each width that of a uniform band of equal spread."""

    def width(values: Floats, minimum: float) -> float:
        finite = values[np.isfinite(values)]
        return max(float(np.sqrt(12) * finite.std()), minimum) if len(finite) else minimum

    return Crowd(
        per_m=max(per_m, 0.1),
        up_m=width(views.offset_m[:, 1], 0.2),
        depth_m=width(np.abs(views.offset_m[:, 2]), 0.1),
        length_width=width(np.log(views.length_m), 0.3),
        diameter_width=width(np.log(views.diameter_m), 0.1),
    )


def _size_ratio(
    first: Floats, second: Floats, sd: Floats, partial: tuple[Bools, Bools], width: float
) -> Floats:
    """Return the log likelihood ratio of two sizes: of one fruit, against those of any other two.

    Parameters
    ----------
    first, second : ndarray of float64, shape (K,)
        The sizes, metres; NaN is ignored.
    sd : ndarray of float64, shape (K,)
        Standard deviation of their log ratio.
    partial : tuple of ndarray of bool, shape (K,)
        Which of them are lower bounds: then the full one is at least as large, and two bounds
        say nothing.
    width : float
        Width of the logarithm of sizes among all fruit.

    Examples
    --------
    >>> a, b, no = np.array([0.30, 0.30]), np.array([0.30, 0.20]), np.zeros(2, bool)
    >>> _size_ratio(a, b, np.full(2, 0.02), (no, no), 1.0).round(1).tolist()
    [2.9, -2.6]
    >>> _size_ratio(b, a, np.full(2, 0.02), (~no, no), 1.0).round(1).tolist()
    [-0.8, -0.2]
    """
    from scipy.special import ndtr

    gap = np.log(second) - np.log(first)
    core = np.exp(-0.5 * np.square(gap / sd)) / (np.sqrt(2 * np.pi) * sd)
    tail = (np.abs(gap) < _SIZE_ERROR_MAX) / (2 * _SIZE_ERROR_MAX)
    comparable = np.isfinite(gap)
    both_partial = partial[0] & partial[1]
    # A bound lies below the full size by anything up to `MOST_HIDDEN`.
    short = np.where(partial[0], gap, -gap)
    noise = np.maximum(sd, _LONGEST_PAST)
    below = (ndtr(short / noise) - ndtr((short - _MOST_HIDDEN) / noise)) / _MOST_HIDDEN
    density = np.where(partial[0] | partial[1], below, core)
    mixed = (1 - _SIZE_TAIL) * density + _SIZE_TAIL * np.maximum(tail, 0.05)
    ratio = np.log(np.where(comparable, mixed, 1.0) * width)
    return np.asarray(np.where(comparable & ~both_partial, ratio, 0.0), np.float64)


def shape_ratio(views: RowViews, i: Ints, j: Ints, crowd: Crowd) -> Floats:
    """Return the log likelihood ratio of length and diameter of views i and j, shape (K,)."""
    not_partial = np.zeros(len(i), bool)
    length_sd = np.hypot(views.length_sd[i], views.length_sd[j])
    diameter_sd = np.hypot(views.diameter_sd[i], views.diameter_sd[j])
    hidden = views.partial[i], views.partial[j]
    length = _size_ratio(
        views.length_m[i], views.length_m[j], length_sd, hidden, crowd.length_width
    )
    diameter = _size_ratio(
        views.diameter_m[i],
        views.diameter_m[j],
        diameter_sd,
        (not_partial, not_partial),
        crowd.diameter_width,
    )
    return length + diameter


@dataclass(frozen=True, eq=False)
class RowFruit:
    """The F fruit of a merged row.

    Parameters
    ----------
    best : ndarray of int64, shape (F,)
        Index of the representative view.
    place_m, place_sd_m : ndarray of float64, shape (F, 3)
        Middle in the row's frame: along, up, into the row; metres.
    length_m, length_sd : ndarray of float64, shape (F,)
        Length of all whole views together (`pooled_length`), or of the best one where none is
        whole; NaN where none has a length; and its relative standard deviation.
    partial : ndarray of bool, shape (F,)
        Whether that is a lower bound.
    """

    best: Ints
    place_m: Floats
    place_sd_m: Floats
    length_m: Floats
    length_sd: Floats
    partial: Bools

    def __len__(self) -> int:
        """Return the number of fruit."""
        return len(self.best)


def best_views(merged: Merged, views: RowViews) -> Ints:
    """Return the representative view of each fruit, shape (F,).

    One with a length before one without, one that shows the whole fruit before a lower bound,
    then the higher view score, then the narrower length.
    """
    order = np.lexsort(
        (
            views.length_sd,
            -views.view_score,
            views.partial,
            ~np.isfinite(views.length_m),
            merged.cluster,
        )
    )
    _, first = np.unique(merged.cluster[order], return_index=True)
    return np.asarray(order[first], np.int64)


def row_fruit(merged: Merged, views: RowViews) -> RowFruit:
    """Return the fruit of a merged row: place and length from all views of each."""
    best = best_views(merged, views)
    length_m, length_sd = views.length_m[best], views.length_sd[best]
    for f in np.flatnonzero(~views.partial[best]):
        members = np.flatnonzero(merged.cluster == f)
        length = pooled_length(
            views.length_m[members], views.length_sd[members], views.partial[members]
        )
        if length is not None:
            length_m[f], length_sd[f] = length[0], length[1] / length[0]
    place = merged.place_m(views)
    weight = 1.0 / views.offset_sd_m**2
    count = len(best)
    sums = np.stack([np.bincount(merged.cluster, weight[:, c], count) for c in range(3)], axis=1)
    middle = np.stack(
        [np.bincount(merged.cluster, weight[:, c] * place[:, c], count) for c in range(3)], axis=1
    )
    stop_sd = merged.stops.sd_m[views.stop[best]]
    return RowFruit(
        best=best,
        place_m=middle / sums,
        place_sd_m=np.sqrt(1.0 / sums + stop_sd**2),
        length_m=length_m,
        length_sd=length_sd,
        partial=views.partial[best],
    )
