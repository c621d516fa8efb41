"""Find the same fruit on a later day, after growth and after lowering and re-hanging the row.

The shift of the plants is unknown and may vary along the row: it is searched on a grid for each
stretch, then estimated together with the links, with neighbouring stretches alike. A fruit may
remain without a link, and each link has a probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cucumbervision.methods.matching import ALONG, UP, log_density
from cucumbervision_greenhouse.rounds.row_views import Floats, Ints, RowFruit, pairs_within

_STAY_SHARE = 0.75  # share of fruit that are still there and seen
# How far a fruit hangs off its plant's shift: along, up, into the row.
_SWING_M = 0.04, 0.04, 0.05
_MOST_ALONG_M, _MOST_UP_M = 1.2, 0.8  # farthest shift that is looked for
_STRETCH_M = 3.0  # length of row whose plants are taken to be moved alike
_CHANGE_M = 0.05  # how far neighbouring stretches usually differ
_STUDENT_FREEDOM = 4.0
_PASSES = 6
_BELIEF_STEPS = 40
_WIDE = 2.5  # how much wider growth is until links show it
_PRIOR_LINKS = 20.0  # weight of the prior of swinging, in links


@dataclass(frozen=True, eq=False)
class DayLinks:
    """Links between two rounds of one row.

    Parameters
    ----------
    pairs : ndarray of int64, shape (K, 2)
        Fruit of the earlier and of the later round, one to one, likelier than not.
    probability : ndarray of float64, shape (K,)
        How likely each is right.
    shift_m, shift_sd_m : ndarray of float64, shape (S, 3)
        How far each stretch was moved, metres.
    """

    pairs: Ints
    probability: Floats
    shift_m: Floats
    shift_sd_m: Floats


def link_days(
    earlier: RowFruit,
    later: RowFruit,
    days: float,
    growth_m: float = 0.03,
    growth_sd_m: float = 0.01,
) -> DayLinks:
    """Link the fruit of one row between two rounds.

    Parameters
    ----------
    earlier, later : RowFruit
        The fruit of both, as `best.row_fruit` gives them.
    days : float
        Between the rounds.
    growth_m, growth_sd_m : float
        What fruit grow by a day, and how far they differ in it, metres.

    Raises
    ------
    ValueError
        If the days are not positive.

    Examples
    --------
    >>> from cucumbervision_greenhouse.rounds.row_views import RowFruit
    >>> place = np.array([[0.5, 0.1, 0.0], [1.1, -0.1, 0.0], [1.9, 0.2, 0.0], [2.6, 0.0, 0.0]])
    >>> def fruit(place, length):
    ...     few = np.full(4, 0.02)
    ...     return RowFruit(np.arange(4), place, np.full((4, 3), 0.01), length, few,
    ...         np.zeros(4, bool))
    >>> before = fruit(place, np.array([0.10, 0.22, 0.15, 0.28]))
    >>> after = fruit(place + [0.3, -0.25, 0.0], np.array([0.13, 0.25, 0.18, 0.31]))
    >>> links = link_days(before, after, 1.0)
    >>> links.pairs.tolist(), links.shift_m[0, :2].round(1).tolist()
    ([[0, 0], [1, 1], [2, 2], [3, 3]], [0.3, -0.2])
    """
    if not days > 0:
        raise ValueError(f"the later round is {days} days after the earlier one")
    a, b = _tops(earlier), _tops(later)
    knots = _knots(a[:, ALONG])
    i, j = _near(a[:, ALONG], b[:, ALONG], _MOST_ALONG_M + 4 * _SWING_M[0])
    grown_m, error_m, width_m = _grown(earlier, later, i, j)
    prior = growth_m * days, growth_sd_m * days
    size = _size_ratio(grown_m, error_m, width_m, prior[0], _WIDE * prior[1])
    noise = earlier.place_sd_m[i] ** 2 + later.place_sd_m[j] ** 2
    noise = noise + _hidden_variance(earlier, later, i, j)
    swing = np.square(_SWING_M)
    # A fruit that is linked to none is new, and what it might be linked to was picked or missed.
    other_density = _other_density(b) + 2 * np.log(1 - _STAY_SHARE)
    shift = _vote(knots, a, b, (i, j), size, noise + swing, other_density)
    field, spread = shift, np.full_like(shift, _SWING_M[0])
    for _ in range(_PASSES):
        moved = _at(knots, field, a[i, ALONG])
        gap = b[j] - a[i] - moved
        variance = noise + swing + _at(knots, spread, a[i, ALONG]) ** 2
        ratio = log_density(gap, variance).sum(axis=1) + size + np.log(_STAY_SHARE) - other_density
        pairs = _assign(i, j, ratio, len(a), len(b))
        field, spread = _fit(knots, a, b, (i[pairs], j[pairs]), variance[pairs], shift)
        swing = _swing(gap[pairs], variance[pairs] - swing)
        growth = _growth(grown_m[pairs], error_m[pairs], prior)
        size = _size_ratio(grown_m, error_m, width_m, *growth)
    chance = _chances(i, j, ratio, len(a), len(b))[pairs]
    likely = chance > 0.5
    linked = np.column_stack([i[pairs], j[pairs]])[likely]
    return DayLinks(pairs=linked, probability=chance[likely], shift_m=field, shift_sd_m=spread)


def _swing(gap: Floats, noise: Floats) -> Floats:
    """Return the variance of fruit about their plants' shift: the prior's and the links' own.

    By the median, so that a fifth of wrong links does little.
    """
    prior = np.square(_SWING_M)
    if not len(gap):
        return prior
    observed = (1.4826 * np.median(np.abs(gap), axis=0)) ** 2 - np.median(noise, axis=0)
    observed = np.clip(observed, prior / 4, prior * 4)
    return np.asarray((_PRIOR_LINKS * prior + len(gap) * observed) / (_PRIOR_LINKS + len(gap)))


def _tops(fruit: RowFruit) -> Floats:
    """Return the upper ends of fruit, shape (F, 3): they stay while a growing middle sinks."""
    top = fruit.place_m.copy()
    top[:, UP] += np.nan_to_num(fruit.length_m, nan=0.15) / 2
    return top


def _knots(along: Floats) -> Floats:
    first_m, last_m = float(along.min(initial=0.0)), float(along.max(initial=0.0))
    count = max(int(np.ceil((last_m - first_m) / _STRETCH_M)), 1)
    return first_m + (np.arange(count) + 0.5) * (last_m - first_m) / count


def _near(a: Floats, b: Floats, gate_m: float) -> tuple[Ints, Ints]:
    i, j = pairs_within(np.concatenate([a, b]), gate_m)
    between = (i < len(a)) & (j >= len(a))
    return i[between], j[between] - len(a)


def _grown(earlier: RowFruit, later: RowFruit, i: Ints, j: Ints) -> tuple[Floats, Floats, float]:
    """Return how much longer each pair is later, its error, and the width of lengths in the row.

    The first is NaN where one of the two is a lower bound, or not known.
    """
    earlier_m, later_m = earlier.length_m[i], later.length_m[j]
    is_partial = earlier.partial[i] | later.partial[j]
    error = np.hypot(earlier_m * earlier.length_sd[i], later_m * later.length_sd[j])
    measured_m = later.length_m[np.isfinite(later.length_m)]
    width = max(float(np.sqrt(12) * measured_m.std()), 0.1) if len(measured_m) else 0.3
    return np.where(is_partial, np.nan, later_m - earlier_m), np.hypot(error, 0.003), width


def _growth(grown_m: Floats, error_m: Floats, prior: tuple[float, float]) -> tuple[float, float]:
    """Return the growth of the row's fruit and its spread: the prior's and the links' own."""
    measured = np.isfinite(grown_m)
    count, (mean_m, sd_m) = int(measured.sum()), prior
    if count:
        middle = float(np.median(grown_m[measured]))
        weight = (_WIDE * sd_m) ** 2 / (sd_m**2 + float(np.median(error_m[measured])) ** 2)
        mean_m += count * weight / (1 + count * weight) * (middle - mean_m)
    return mean_m, sd_m * float(np.hypot(1, _WIDE / (1 + count)))


def _size_ratio(
    grown_m: Floats, error_m: Floats, width_m: float, mean_m: float, sd_m: float
) -> Floats:
    """Return the log likelihood ratio of sizes: of one fruit that grew, against any other."""
    same_fruit = log_density(grown_m - mean_m, error_m**2 + sd_m**2) + np.log(width_m)
    return np.asarray(np.where(np.isnan(grown_m), 0.0, np.maximum(same_fruit, -6.0)), np.float64)


def _hidden_variance(earlier: RowFruit, later: RowFruit, i: Ints, j: Ints) -> Floats:
    """Return the variance that hidden parts add to upper ends, shape (K, 3)."""
    lost = 0.06**2 * (earlier.partial[i].astype(float) + later.partial[j])
    return np.stack([0 * lost, lost, 0 * lost], axis=1)


def _other_density(b: Floats) -> float:
    """Return the log density of fruit in the row, per cubic metre."""
    width = np.maximum(np.sqrt(12) * b.std(axis=0), [0.5, 0.2, 0.1])
    return float(np.log(max(len(b), 1) / width.prod()))


def _at(knots: Floats, values: Floats, along: Floats) -> Floats:
    return np.stack([np.interp(along, knots, values[:, c]) for c in range(3)], axis=1)


def _vote(
    knots: Floats,
    a: Floats,
    b: Floats,
    pairs: tuple[Ints, Ints],
    size: Floats,
    noise: Floats,
    other_density: float,
) -> Floats:
    """Find each stretch's shift on a grid; stretches that see little follow the whole row."""
    from scipy.ndimage import gaussian_filter

    i, j = pairs
    step = 0.02
    gap = (b[j] - a[i])[:, :2]
    half = np.array([_MOST_ALONG_M, _MOST_UP_M])
    bins = [np.arange(-h, h + step, step) for h in half]
    core = np.sqrt(np.median(noise[:, :2], axis=0)) / step if len(i) else np.ones(2)
    # How much a pair adds at its own shift, beyond what other fruit do by chance.
    height = size + log_density(0.0, noise).sum(axis=1) + np.log(_STAY_SHARE) - other_density
    weight = np.log1p(np.exp(np.minimum(height, 20.0)))
    stretch = np.abs(a[i, ALONG, None] - knots).argmin(axis=1)
    grids = []
    for k in range(len(knots)):
        of_stretch = stretch == k
        grid, *_ = np.histogram2d(
            gap[of_stretch, 0], gap[of_stretch, 1], bins, weights=weight[of_stretch]
        )
        grids.append(gaussian_filter(grid, core) * 2 * np.pi * core.prod())
    middles = [edges[:-1] + step / 2 for edges in bins]
    x, y = np.meshgrid(*middles, indexing="ij")
    prior = -0.5 * (x**2 / 0.5**2 + y**2 / 0.3**2)
    row_shift = _peak(sum(grids, prior), middles)
    shifts = np.zeros((len(knots), 3))
    for k in range(len(knots)):
        neighbour_grids = sum(grids[max(k - 1, 0) : k + 2], np.zeros_like(prior))
        off = (x - row_shift[0]) ** 2 + (y - row_shift[1]) ** 2
        shifts[k, :2] = _peak(
            neighbour_grids + np.log(0.9 * np.exp(-0.5 * off / 0.1**2) + 0.02), middles
        )
    return shifts


def _peak(grid: Floats, middles: list[Floats]) -> tuple[float, float]:
    peak = np.unravel_index(int(grid.argmax()), grid.shape)
    return float(middles[0][peak[0]]), float(middles[1][peak[1]])


def _assign(i: Ints, j: Ints, ratio: Floats, rows: int, columns: int) -> Ints:
    """Return which pairs are assigned, one to one; a pair below even odds is none."""
    from scipy.optimize import linear_sum_assignment

    pair = np.full((rows, columns), -1)
    pair[i, j] = np.arange(len(i))
    gain = np.where(pair >= 0, np.maximum(ratio, 0.0)[pair], 0.0) if len(i) else pair
    chosen = np.asarray(pair[linear_sum_assignment(gain, maximize=True)], np.intp)
    chosen = chosen[chosen >= 0]
    return chosen[ratio[chosen] > 0]


def _fit(
    knots: Floats, a: Floats, b: Floats, pairs: tuple[Ints, Ints], noise: Floats, voted: Floats
) -> tuple[Floats, Floats]:
    """Estimate the shifts of all stretches from the links, smooth but for some jumps."""
    i, j = pairs
    count = len(knots)
    basis = np.stack([np.interp(a[i, ALONG], knots, line) for line in np.eye(count)], axis=1)
    field, spread = voted.copy(), np.empty_like(voted)
    steps = np.diff(np.eye(count), axis=0)
    for c in range(3):
        target = b[j, c] - a[i, c]
        for _ in range(4):
            misfit = (target - basis @ field[:, c]) ** 2 / noise[:, c]
            trust = (_STUDENT_FREEDOM + 1) / (_STUDENT_FREEDOM + misfit) / noise[:, c]
            jump = (steps @ field[:, c]) ** 2 / _CHANGE_M**2
            stiff = 2.0 / (1.0 + jump) / _CHANGE_M**2
            information = (basis.T * trust) @ basis + (steps.T * stiff) @ steps
            information += np.eye(count) / 0.5**2
            pull = basis.T @ (trust * target) + voted[:, c] / 0.5**2
            field[:, c] = np.linalg.solve(information, pull)
        spread[:, c] = np.sqrt(np.diag(np.linalg.inv(information)))
    return field, spread


def _chances(i: Ints, j: Ints, ratio: Floats, rows: int, columns: int) -> Floats:
    """Return how likely each pair is, of all one-to-one assignments and none.

    Marginals by belief propagation, as in Williams & Lau (2014), "Approximate evaluation of
    marginal association probabilities with belief propagation".
    """
    weight = np.exp(np.clip(ratio, -30.0, 30.0))
    to_row = np.ones(len(weight))
    for _ in range(_BELIEF_STEPS):
        row_weight = weight * to_row
        to_column = weight / (1.0 + np.bincount(i, row_weight, rows)[i] - row_weight)
        to_row = 1.0 / (1.0 + np.bincount(j, to_column, columns)[j] - to_column)
    row_weight = weight * to_row
    return np.asarray(row_weight / (1.0 + np.bincount(i, row_weight, rows)[i]), np.float64)
