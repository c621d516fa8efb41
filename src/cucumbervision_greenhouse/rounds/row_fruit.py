"""The fruit of a merged row: the representative measurement of each, and how many there are.

A view seen once may be a false positive, and some fruit were never seen. A fruit is seen by each
capture that could show it with one probability q; a false positive is seen once. Both shares are
learnt from the row itself by expectation maximisation (Dempster, Laird & Rubin 1977), with weak
priors, so that a short row does not run away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.measurement.matching import DEPTH, pooled_length

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.measurement.result import Length
    from cucumbervision_greenhouse.rounds.merge import Merged
    from cucumbervision_greenhouse.rounds.row_views import Bools, Floats, Ints, RowStops, RowViews


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


_MOST_APART_SD, _MOST_WIDER = 2.5, 1.5


def joint_tube_is_used(tube: Length, pooled: tuple[float, float] | None) -> bool:
    """Return whether the length of the joint tube replaces the pooled length.

    It does not where the views' own lengths contradict it (views of two fruit that were taken
    for one fit no tube), nor where it is much less sure than they are. How far apart and how
    unsure was set on simulated fruit found by networks (`benchmarks/many_views.py --perceived`).

    Parameters
    ----------
    tube : Length
        Of the tube; one without an interval is not used.
    pooled : tuple of float, optional
        Length and standard deviation, as `pooled_length` gives them.

    Examples
    --------
    >>> from cucumbervision.measurement.result import Length
    >>> joint_tube_is_used(Length(0.30, low_m=0.29, high_m=0.31), (0.304, 0.006))
    True
    >>> joint_tube_is_used(Length(0.35, low_m=0.34, high_m=0.36), (0.304, 0.006))
    False
    """
    tube_sd = tube.relative_sd
    if tube_sd is None or pooled is None:
        return tube_sd is not None
    length_m, sd_m = pooled
    sd = sd_m / length_m
    apart = abs(math.log(tube.value_m / length_m)) / sd
    wider = tube_sd / sd
    return apart < _MOST_APART_SD and wider < _MOST_WIDER


_MARGIN_M = 0.03  # a fruit closer to a picture's edge may be outside
_SEEN, _SEEN_WEIGHT = 0.9, 20.0  # prior of q, and its weight as a number of captures
_FALSE, _FALSE_WEIGHT = 0.02, 50.0  # prior of false positives
_MOST_LEARNT = 500  # views; a house changes
# With fewer of its chances to show a fruit again come true, a row's pictures are unrelated.
_LEAST_SEEN_AGAIN, _CHANCES = 0.25, 10
_MOST_ITERATIONS = 400  # it converges slowly if many fruit are hidden
_STILL = 1e-9  # change of a probability from one iteration to the next


@dataclass(frozen=True)
class FalseShare:
    """Prior of the share of false positives in a row.

    Parameters
    ----------
    share : float
        Of all views.
    weight : float
        How many views that is worth.
    """

    share: float = _FALSE
    weight: float = _FALSE_WEIGHT

    @classmethod
    def learnt(cls, rejected: int, views: int) -> FalseShare:
        """Return the prior from a house's verdicts: how many of how many views were not fruit.

        Examples
        --------
        >>> FalseShare.learnt(0, 0) == FalseShare()
        True
        >>> round(FalseShare.learnt(30, 500).share, 3)
        0.056
        """
        weight = _FALSE_WEIGHT + min(views, _MOST_LEARNT)
        share = rejected / views if views else 0.0
        return cls((_FALSE * _FALSE_WEIGHT + share * min(views, _MOST_LEARNT)) / weight, weight)


USUAL = FalseShare()
"""The prior of a house without verdicts."""


@dataclass(frozen=True, eq=False)
class CountEstimate:
    """How many fruit there are.

    Parameters
    ----------
    expected, sd : float
        Number of fruit that the captures could show, those included that none did.
    view_counts, capture_counts : ndarray of int64, shape (F,)
        For each fruit found: how many views it has, and how many captures could show it.
    real : ndarray of float64, shape (F,)
        How likely it is a fruit and no false positive.
    seen_again : float
        The share q.
    """

    expected: float
    sd: float
    view_counts: Ints
    capture_counts: Ints
    real: Floats
    seen_again: float

    @classmethod
    def of_nothing(cls) -> CountEstimate:
        """Return the count of a row without detections."""
        none: Ints = np.zeros(0, np.int64)
        return cls(
            expected=0.0,
            sd=0.0,
            view_counts=none,
            capture_counts=none,
            real=np.zeros(0),
            seen_again=_SEEN,
        )

    @classmethod
    def counted(cls, fruit: int) -> CountEstimate:
        """Return the count of fruit without an estimate of missed ones.

        Examples
        --------
        >>> CountEstimate.counted(65).expected, CountEstimate.counted(65).interval()
        (65.0, (65, 65))
        """
        ones = np.ones(fruit, np.int64)
        return cls(
            expected=float(fruit),
            sd=0.0,
            view_counts=ones,
            capture_counts=ones,
            real=np.ones(fruit),
            seen_again=1.0,
        )

    def interval(self, level: float = 0.9) -> tuple[int, int]:
        """Return the interval, in whole numbers, of the number of fruit.

        Examples
        --------
        >>> views = np.repeat([3, 2, 1], [90, 10, 6])
        >>> count = estimate_count(views, np.full(106, 3), np.full(106, 0.8), np.zeros(0))
        >>> lower, upper = count.interval()
        >>> lower <= count.expected <= upper
        True
        """
        z = NormalDist().inv_cdf(0.5 + level / 2)
        reach = z * math.sqrt(self.sd**2 + self.expected_variance())
        lower, upper = math.floor(self.expected - reach), math.ceil(self.expected + reach)
        return max(lower, 0), upper

    def expected_variance(self) -> float:
        """Return the variance of `expected` that the uncertainty of q gives it.

        By the delta method, with the information that the numbers of views hold of q beyond its
        prior: that of binomials of which the zeros are not seen. A fruit that one capture could
        show, and did, says nothing of q.
        """
        if self.seen_again == 1.0:
            return 0.0
        q, k, nothing = (
            self.seen_again,
            self.capture_counts,
            (1 - self.seen_again) ** self.capture_counts,
        )
        mean = k * q / (1 - nothing)
        spread = mean * (1 - q + k * q - mean)
        information = _SEEN_WEIGHT / (q * (1 - q)) + (self.real * spread).sum() / (q * (1 - q)) ** 2
        slope = (self.real * k * nothing / (1 - q) / (1 - nothing) ** 2).sum()
        return float(slope**2 / information)


def count_fruit(
    merged: Merged,
    stops: RowStops,
    views: RowViews,
    accepted: Bools | None = None,
    false: FalseShare = USUAL,
) -> CountEstimate:
    """Count the fruit of a merged row.

    Captures that should show fruit again, and hardly do, are of different rows or have wrong
    places: missed fruit are then not estimated.

    Parameters
    ----------
    merged, stops, views : Merged, RowStops, RowViews
        The row.
    accepted : ndarray of bool, shape (N,), optional
        Views that a person accepted as fruit.
    false : FalseShare
        Prior of the share of false positives.
    """
    view_counts = np.bincount(merged.cluster)
    capture_counts = np.maximum(times_shown(merged, stops, views), view_counts)
    score = np.zeros(len(view_counts))
    np.maximum.at(score, merged.cluster, views.score)
    chances = int((capture_counts - 1).sum())
    if chances >= _CHANCES and (view_counts - 1).sum() < _LEAST_SEEN_AGAIN * chances:
        return CountEstimate.counted(len(view_counts))
    accepted_fruit = np.zeros(len(view_counts), bool)
    if accepted is not None:
        accepted_fruit[merged.cluster[accepted]] = True
    sure = views.score[(view_counts > 1)[merged.cluster] | accepted_fruit[merged.cluster]]
    return estimate_count(view_counts, capture_counts, score, sure, accepted_fruit, false)


def found_share(counts: Sequence[CountEstimate]) -> tuple[float, float, float]:
    """Return which share of the fruit of some rows was found, its uncertainty, and false ones.

    Parameters
    ----------
    counts : sequence of CountEstimate
        Of merged rows; without any the priors stand.

    Returns
    -------
    found, found_sd : float
        Share of the fruit that were found, and its standard deviation.
    false : float
        Share of what was found that is no fruit.

    Examples
    --------
    Fifty fruit that one capture each could show: how often such are missed is only believed.

    >>> ones = np.ones(50, np.int64)
    >>> count = CountEstimate(50 / 0.9, 0.0, ones, ones, np.ones(50), 0.9)
    >>> [round(share, 3) for share in found_share([count])]
    [0.9, 0.067, 0.0]
    """
    detections = sum(len(count.view_counts) for count in counts)
    real = sum(float(count.real.sum()) for count in counts)
    expected = sum(count.expected for count in counts)
    if not detections or not real:
        return _SEEN, float(np.sqrt(_SEEN * (1 - _SEEN) / _SEEN_WEIGHT)), _FALSE
    share = min(real / expected, 1.0)
    sd = np.sqrt(sum(count.expected_variance() for count in counts)) / expected
    return share, share * float(sd), 1.0 - real / detections


def times_shown(merged: Merged, stops: RowStops, views: RowViews) -> Ints:
    """Return how many captures could show each fruit, shape (F,).

    Only captures of sides that did see it count: leaves may hide it from the other aisle.
    """
    count = int(merged.cluster.max(initial=-1)) + 1
    place = merged.place_m(views)
    sizes = np.bincount(merged.cluster, minlength=count)
    middle = np.stack(
        [np.bincount(merged.cluster, place[:, c], count) / sizes for c in range(3)], axis=1
    )
    by_side = np.zeros((count, 2), bool)
    by_side[merged.cluster, stops.side[views.stop]] = True
    _, first_view = np.unique(views.capture, return_index=True)
    captures = views.stop[first_view]
    times = np.zeros(count, np.int64)
    for s in captures.tolist():
        gap = np.abs(middle - merged.stops.at_m[s])
        half = stops.reach[s] * gap[:, DEPTH, None] - _MARGIN_M
        times += (gap[:, :2] < half).all(axis=1) & by_side[:, stops.side[s]]
    return times


def estimate_count(
    view_counts: Ints,
    capture_counts: Ints,
    score: Floats,
    sure_scores: Floats,
    accepted_fruit: Bools | None = None,
    false: FalseShare = USUAL,
) -> CountEstimate:
    """Estimate how many fruit there are from how often each was seen.

    Parameters
    ----------
    view_counts, capture_counts : ndarray of int64, shape (F,)
        Views of each fruit, and captures that could show it, at least as many.
    score : ndarray of float64, shape (F,)
        The detector's confidence in each.
    sure_scores : ndarray of float64, shape (V,)
        Its confidence in views of fruit that were seen twice or more. False positives are assumed
        to have any confidence from the least to the highest alike.
    accepted_fruit : ndarray of bool, shape (F,), optional
        Whether a person accepted each as a fruit.
    false : FalseShare
        Prior of the share of false positives.

    Examples
    --------
    A hundred fruit that three captures could show, 90 seen by all and 10 by two; and six things
    that were seen once:

    >>> views = np.repeat([3, 2, 1], [90, 10, 6])
    >>> count = estimate_count(views, np.full(106, 3), np.full(106, 0.8), np.zeros(0))
    >>> round(count.expected), round(float(count.real[-1]), 1)
    (100, 0.1)
    """
    if not len(view_counts):
        return CountEstimate.of_nothing()
    likelier = _score_ratio(score, sure_scores)
    once = (view_counts == 1) if accepted_fruit is None else (view_counts == 1) & ~accepted_fruit
    q, real = _SEEN, np.where(once, 0.5, 1.0)
    for _ in range(_MOST_ITERATIONS):
        before = q, real
        nothing = (1 - q) ** capture_counts
        single = capture_counts * q * (1 - q) ** (capture_counts - 1) / (1 - nothing)
        false_views = (1 - real).sum() + false.share * false.weight
        false_views *= view_counts.sum() / (view_counts.sum() + false.weight)
        odds = real.sum() / max(float(false_views), 1e-9) * single * likelier
        real = np.where(once, odds / (1 + odds), 1.0)
        unseen = real * nothing / (1 - nothing)
        hits = (real * view_counts).sum() + _SEEN * _SEEN_WEIGHT
        q = float(hits / (((real + unseen) * capture_counts).sum() + _SEEN_WEIGHT))
        q = min(max(q, 0.05), 0.995)
        if max(abs(q - before[0]), float(np.abs(real - before[1]).max())) < _STILL:
            break
    uncertain = float((real * (1 - real)).sum()) * _share_learnt(real[once])
    sd = np.sqrt(uncertain + (unseen * (1 + unseen)).sum())
    return CountEstimate(
        expected=float((real + unseen).sum()),
        sd=float(sd),
        view_counts=view_counts,
        capture_counts=capture_counts,
        real=real,
        seen_again=q,
    )


def _share_learnt(real: Floats) -> float:
    """Return how much variance the estimate of the share of false positives adds.

    By the missing information m of a mixture's share: 1 / (1 - m) (Louis 1982).
    """
    if not len(real):
        return 1.0
    share = float(real.mean())
    missing = float((real * (1 - real)).mean()) / max(share * (1 - share), 1e-9)
    return 1.0 / max(1.0 - missing, 0.25)


def _score_ratio(score: Floats, sure: Floats) -> Floats:
    """Return the likelihood ratio of a confidence: its density among sure fruit, over the range.

    The density is a Beta distribution's, fitted by moments.
    """
    if len(sure) < 20 or float(sure.std()) < 1e-3:
        return np.ones(len(score))
    lowest, highest = min(float(score.min()), float(sure.min())), 1.0
    spread = max(highest - lowest, 1e-3)
    scaled = np.clip((sure - lowest) / spread, 0.01, 0.99)
    mean, variance = float(scaled.mean()), float(scaled.var())
    common = max(mean * (1 - mean) / variance - 1, 0.1)
    scaled_score = np.clip((score - lowest) / spread, 0.01, 0.99)
    a, b = mean * common, (1 - mean) * common
    # As `scipy.stats.beta.pdf`, whose import takes a second.
    log_of_all = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    log_density = (a - 1) * np.log(scaled_score) + (b - 1) * np.log1p(-scaled_score)
    density = np.exp(log_density - log_of_all)
    return np.asarray(np.clip(density, 0.02, 5.0), np.float64)
