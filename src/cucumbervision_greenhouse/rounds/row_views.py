"""One row as arrays: its stops, its views, how alike two views are, and where the stops were.

All stops of a row are estimated together: each has a normal prior about the position that the
operator gave, and each pair of views of one fruit measures the distance of its two stops. Wrong
pairs are downweighted by Student-t weights (iteratively reweighted least squares; Lange, Little &
Taylor 1989).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cucumbervision.methods.matching import ALONG, Crowd, log_density, pooled_length, position_ratio

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
    reach : ndarray of float64, shape (S,)
        Tangent of half the field of view along the row.
    covariance_m2 : ndarray of float64, shape (3, S, S), optional
        Of each coordinate, where the stops were estimated together.
    """

    at_m: Floats
    sd_m: Floats
    side: Ints
    reach: Floats
    covariance_m2: Floats | None = None

    def __len__(self) -> int:
        """Return the number of stops."""
        return len(self.side)

    def gap_variance(self, s: Ints, t: Ints) -> Floats:
        """Return the variance of how far stops s and t lie apart, shape (K, 3)."""
        if self.covariance_m2 is None:
            between = np.where((s == t)[:, None], self.sd_m[s] ** 2, 0.0)
        else:
            between = np.moveaxis(self.covariance_m2[:, s, t], 0, -1)
        apart = self.sd_m[s] ** 2 + self.sd_m[t] ** 2 - 2 * between
        return np.asarray(np.maximum(apart, 0.0), np.float64)


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
        Indices, i below j, in their order.

    Examples
    --------
    >>> i, j = pairs_within(np.array([0.3, 0.0, 0.1, 0.9]), 0.25)
    >>> list(zip(i.tolist(), j.tolist()))
    [(0, 2), (1, 2)]
    """
    from scipy.spatial import KDTree

    widest, reach_m = float(np.max(gate, initial=0.0)), np.broadcast_to(gate, values.shape)
    pairs = KDTree(values[:, None]).query_pairs(widest, output_type="ndarray")
    i, j = pairs[np.lexsort(pairs.T[::-1])].T
    within = np.abs(values[i] - values[j]) <= np.maximum(reach_m[i], reach_m[j])
    return i[within], j[within]


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


def best_views(cluster: Ints, views: RowViews) -> Ints:
    """Return the representative view of each fruit, shape (F,).

    One with a length before one without, one that shows the whole fruit before a lower bound,
    then the higher view score, then the narrower length.
    """
    unmeasured = ~np.isfinite(views.length_m)
    order = np.lexsort((views.length_sd, -views.view_score, views.partial, unmeasured, cluster))
    _, first = np.unique(cluster[order], return_index=True)
    return np.asarray(order[first], np.int64)


def row_fruit(cluster: Ints, stops: RowStops, views: RowViews) -> RowFruit:
    """Return the fruit of a merged row: place and length from all views of each.

    Parameters
    ----------
    cluster : ndarray of int64, shape (N,)
        Number of each view's fruit, from 0.
    stops : RowStops
        The stops, as they were estimated.
    views : RowViews
        The views.
    """
    best = best_views(cluster, views)
    length_m, length_sd = views.length_m[best], views.length_sd[best]
    for f in np.flatnonzero(~views.partial[best]):
        members = np.flatnonzero(cluster == f)
        length = pooled_length(
            views.length_m[members], views.length_sd[members], views.partial[members]
        )
        if length is not None:
            length_m[f], length_sd[f] = length[0], length[1] / length[0]
    place, weight = stops.at_m[views.stop] + views.offset_m, 1.0 / views.offset_sd_m**2

    def by_fruit(values: Floats) -> Floats:
        sums = np.zeros((len(best), 3))
        np.add.at(sums, cluster, values)
        return sums

    weights = by_fruit(weight)
    return RowFruit(
        best=best,
        place_m=by_fruit(weight * place) / weights,
        place_sd_m=np.sqrt(1.0 / weights + stops.sd_m[views.stop[best]] ** 2),
        length_m=length_m,
        length_sd=length_sd,
        partial=views.partial[best],
    )


_STUDENT_FREEDOM = 4.0  # degrees of freedom of Student's t
_ITERATIONS = 6  # of reweighting
_STEP_M = 0.01  # step of the candidate shifts
_REACH_SD = 3.5  # search range, in standard deviations
_MOST_TRIED = 121


def fit_stops(stops: RowStops, views: RowViews, i: Ints, j: Ints, weight: Floats) -> RowStops:
    """Estimate all stops of a row together.

    Parameters
    ----------
    stops : RowStops
        What was declared.
    views : RowViews
        The detections.
    i, j : ndarray of intp, shape (K,)
        Pairs of views of one fruit.
    weight : ndarray of float64, shape (K,)
        What each counts for: of the m (m - 1) / 2 pairs of m views 2 / m, since then they say as
        much as the m views do about their common middle.

    Returns
    -------
    RowStops
        As they were estimated.

    Examples
    --------
    Two stops, given as 0.40 m apart with 3 cm of uncertainty each; two fruit in both measure 0.46:

    >>> stops = RowStops(np.array([[0.0, 0, 0], [0.4, 0, 0]]), np.full((2, 3), 0.03),
    ...     np.zeros(2, int), np.ones(2))
    >>> middle = np.array([[0.3, 0, 0.7], [0.4, 0, 0.7], [-0.16, 0, 0.7], [-0.06, 0, 0.7]])
    >>> none, few = np.full(4, np.nan), np.full(4, 0.02)
    >>> views = RowViews(np.array([0, 0, 1, 1]), np.array([0, 0, 1, 1]), middle,
    ...     np.full((4, 3), 0.003), none, few, none, few, np.zeros(4, bool), np.ones(4))
    >>> fitted = fit_stops(stops, views, np.array([0, 1]), np.array([2, 3]), np.ones(2))
    >>> (100 * fitted.at_m[:, 0]).round(1).tolist()
    [-3.0, 43.0]
    """
    apart = views.stop[i] != views.stop[j]  # two captures of one stop do not locate it
    i, j, weight = i[apart], j[apart], weight[apart]
    s, t = views.stop[i], views.stop[j]
    between = views.offset_m[i] - views.offset_m[j]
    variance = views.offset_sd_m[i] ** 2 + views.offset_sd_m[j] ** 2
    # In the order along the row only near neighbours share fruit: the equations are banded.
    order = np.argsort(stops.at_m[:, ALONG], kind="stable")
    place = np.argsort(order)
    at_m = np.empty_like(stops.at_m)
    covariance = np.empty((3, len(stops), len(stops)))
    for c in range(3):
        prior = stops.at_m[order, c], stops.sd_m[order, c] ** 2
        ends = place[s], place[t]
        x, spread = _fit_one(prior, ends, between[:, c], variance[:, c], weight)
        at_m[:, c], covariance[c] = x[place], spread[np.ix_(place, place)]
    sd_m = np.sqrt(np.einsum("css->sc", covariance))
    return replace(stops, at_m=at_m, sd_m=sd_m, covariance_m2=covariance)


def _fit_one(
    prior: tuple[Floats, Floats],
    ends: tuple[Ints, Ints],
    between: Floats,
    variance: Floats,
    weight: Floats,
) -> tuple[Floats, Floats]:
    """Solve one coordinate: x_t - x_s = between, with x about the prior; stops in order."""
    from scipy.linalg import solveh_banded

    mean, prior_variance = prior
    s, t = ends
    size, x = len(mean), mean
    band = int(np.abs(s - t).max(initial=0))
    information = np.zeros((band + 1, size))
    for _ in range(_ITERATIONS):
        misfit = (between - (x[t] - x[s])) ** 2 / variance
        trust = weight * (_STUDENT_FREEDOM + 1) / (_STUDENT_FREEDOM + misfit) / variance
        information = np.zeros((band + 1, size))
        information[0] = (
            1.0 / prior_variance + np.bincount(s, trust, size) + np.bincount(t, trust, size)
        )
        np.subtract.at(information, (np.abs(s - t), np.minimum(s, t)), trust)
        target = mean / prior_variance
        target += np.bincount(t, trust * between, size) - np.bincount(s, trust * between, size)
        x = solveh_banded(information, target, lower=True)
    return x, solveh_banded(information, np.eye(size), lower=True)


def vote_pairs(
    stops: RowStops, views: RowViews, i: Ints, j: Ints, crowd: Crowd
) -> tuple[Ints, Ints, float]:
    """Find the first pairs: for each two stops, try shifts along the row and take the likeliest.

    Parameters
    ----------
    stops, views : RowStops, RowViews
        The row.
    i, j : ndarray of intp, shape (K,)
        Pairs that may be one fruit, of different stops.
    crowd : Crowd
        The other fruit.

    Returns
    -------
    i, j : ndarray of intp, shape (L,)
        Pairs that are each other's best at the likeliest shift of their stops.
    support : float
        Sum of the log likelihood ratios of all stops' shifts; the higher, the better the views
        fit together.
    """
    swap = views.stop[i] > views.stop[j]
    i, j = np.where(swap, j, i), np.where(swap, i, j)
    order = np.lexsort((j, i, views.stop[j], views.stop[i]))
    i, j = i[order], j[order]
    if not len(i):
        return i, j, 0.0
    s, t = views.stop[i], views.stop[j]
    gap = stops.at_m[t] + views.offset_m[j] - stops.at_m[s] - views.offset_m[i]
    noise = views.offset_sd_m[i] ** 2 + views.offset_sd_m[j] ** 2
    shift_sd = np.sqrt(stops.sd_m[s] ** 2 + stops.sd_m[t] ** 2)
    variance = noise + np.where(np.arange(3) == ALONG, _STEP_M**2 / 4, shift_sd**2)
    other_ratio = position_ratio(np.where(np.arange(3) == ALONG, 0.0, gap), variance, crowd)
    other_ratio += shape_ratio(views, i, j, crowd) - log_density(0.0, variance[:, ALONG])
    widest = _REACH_SD * float(shift_sd[:, ALONG].max())
    tried = np.linspace(-widest, widest, min(2 * int(widest / _STEP_M) + 1, _MOST_TRIED))
    ratio = other_ratio[:, None] + log_density(
        gap[:, ALONG, None] - tried, variance[:, ALONG, None]
    )
    group = _starts(s, t)
    view_starts = _starts(s, t, i)
    of_one = np.log1p(np.add.reduceat(np.exp(np.minimum(ratio, 50.0)), view_starts, axis=0))
    score = np.add.reduceat(of_one, np.searchsorted(view_starts, group), axis=0)
    score -= 0.5 * (tried / shift_sd[group, ALONG, None]) ** 2
    best = score.argmax(axis=1)
    sizes = np.diff(np.append(group, len(i)))
    at_best = ratio[np.arange(len(i)), np.repeat(best, sizes)]
    mutual = _mutual(np.repeat(np.arange(len(group)), sizes), i, j, at_best)
    return i[mutual], j[mutual], float(score.max(axis=1).sum())


def _starts(*keys: Ints) -> Ints:
    """Return where runs of equal keys start."""
    changed = np.zeros(len(keys[0]), bool)
    changed[0] = True
    for key in keys:
        changed[1:] |= key[1:] != key[:-1]
    return np.flatnonzero(changed)


def _mutual(group: Ints, i: Ints, j: Ints, ratio: Floats) -> Bools:
    """Return which pairs are the best of both their views within a group, and likelier than not."""
    is_best = ratio > 0
    for view in (i, j):
        key = group * (max(int(i.max()), int(j.max())) + 1) + view
        best: Floats = np.full(int(key.max()) + 1, -np.inf)
        np.maximum.at(best, key, ratio)
        is_best &= ratio >= best[key]
    return is_best
