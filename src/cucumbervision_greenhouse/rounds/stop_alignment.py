"""Estimate the positions of a row's stops from the fruit that they share.

All stops of a row are estimated together: each has a normal prior about the position that the
operator gave, and each pair of views of one fruit measures the distance of its two stops. Wrong
pairs are downweighted by Student-t weights (iteratively reweighted least squares; Lange, Little &
Taylor 1989).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.methods.matching import ALONG, log_density, position_ratio
from cucumbervision_greenhouse.rounds.row_views import shape_ratio

if TYPE_CHECKING:
    from cucumbervision.methods.matching import Crowd
    from cucumbervision_greenhouse.rounds.row_views import Bools, Floats, Ints, RowStops, RowViews

_STUDENT_FREEDOM = 4.0  # degrees of freedom of Student's t
_ITERATIONS = 6  # of reweighting
_STEP_M = 0.01  # step of the candidate shifts
_REACH_SD = 3.5  # search range, in standard deviations
_MOST_TRIED = 121


@dataclass(frozen=True, eq=False)
class FittedStops:
    """Stops as estimated.

    Parameters
    ----------
    at_m : ndarray of float64, shape (S, 3)
        Along, up, into the row, metres.
    covariance_m2 : ndarray of float64, shape (3, S, S)
        Of each coordinate.
    """

    at_m: Floats
    covariance_m2: Floats

    @property
    def sd_m(self) -> Floats:
        """Standard deviations, shape (S, 3), metres."""
        return np.asarray(np.sqrt(np.einsum("css->sc", self.covariance_m2)), np.float64)

    def gap_variance(self, s: Ints, t: Ints) -> Floats:
        """Return the variance of how far stops s and t lie apart, shape (K, 3)."""
        variance_m2 = np.einsum("css->sc", self.covariance_m2)
        between = np.moveaxis(self.covariance_m2[:, s, t], 0, -1)
        return np.asarray(
            np.maximum(variance_m2[s] + variance_m2[t] - 2 * between, 0.0), np.float64
        )


def prior_stops(stops: RowStops) -> FittedStops:
    """Return the stops at their declared places, before any alignment."""
    covariance = np.zeros((3, len(stops), len(stops)))
    index = np.arange(len(stops))
    covariance[:, index, index] = stops.sd_m.T**2
    return FittedStops(stops.at_m, covariance)


def fit_stops(stops: RowStops, views: RowViews, i: Ints, j: Ints, weight: Floats) -> FittedStops:
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
    FittedStops

    Examples
    --------
    Two stops, given as 0.40 m apart with 3 cm of uncertainty each; two fruit in both measure 0.46:

    >>> from cucumbervision_greenhouse.rounds.row_views import RowStops, RowViews
    >>> stops = RowStops(np.array([[0.0, 0, 0], [0.4, 0, 0]]), np.full((2, 3), 0.03),
    ...     np.zeros(2, int), np.ones((2, 2)))
    >>> middle = np.array([[0.3, 0, 0.7], [0.4, 0, 0.7], [-0.16, 0, 0.7], [-0.06, 0, 0.7]])
    >>> none, few = np.full(4, np.nan), np.full(4, 0.02)
    >>> views = RowViews(np.array([0, 0, 1, 1]), np.array([0, 0, 1, 1]), middle,
    ...     np.full((4, 3), 0.003), none, few, none, few, np.zeros(4, bool), np.ones(4), np.ones(4))
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
    return FittedStops(at_m, covariance)


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
