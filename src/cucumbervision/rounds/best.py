"""The measurement that stands for a fruit, and the one that all its views give together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.rounds.merge import Merged
    from cucumbervision.rounds.row_views import RowViews

__all__ = ["RowFruit", "best_views", "combined_length", "row_fruit"]

SHARED = 0.5  # of a view's variance: errors that all views of a fruit have in common
LEAST_SD_M = 0.003


@dataclass(frozen=True, eq=False)
class RowFruit:
    """The F fruit of a merged row.

    Parameters
    ----------
    best : ndarray of int64, shape (F,)
        Index of the view that stands.
    place_m, place_sd_m : ndarray of float64, shape (F, 3)
        Middle in the row's frame: along, up, into the row; metres.
    length_m, length_sd : ndarray of float64, shape (F,)
        Length of the best view, NaN where none has one, and its relative standard deviation.
    partial : ndarray of bool, shape (F,)
        Whether that is a lower bound.
    diameter_m : ndarray of float64, shape (F,)
        Largest diameter likewise.
    """

    best: NDArray[np.int64]
    place_m: NDArray[np.float64]
    place_sd_m: NDArray[np.float64]
    length_m: NDArray[np.float64]
    length_sd: NDArray[np.float64]
    partial: NDArray[np.bool_]
    diameter_m: NDArray[np.float64]

    def __len__(self) -> int:
        """Give the number of fruit."""
        return len(self.best)


def best_views(merged: Merged, views: RowViews) -> NDArray[np.int64]:
    """Give for each fruit the view that stands, shape (F,).

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
    """Give the fruit of a merged row: place from all views, sizes from the best one."""
    best = best_views(merged, views)
    place = merged.place_m(views)
    weight = 1.0 / views.offset_sd_m**2
    count = len(best)
    sums = np.stack([np.bincount(merged.cluster, weight[:, c], count) for c in range(3)], axis=1)
    middle = np.stack(
        [np.bincount(merged.cluster, weight[:, c] * place[:, c], count) for c in range(3)], axis=1
    )
    stop_sd = merged.stops.sd_m[views.stop[best]]
    return RowFruit(
        best,
        middle / sums,
        np.sqrt(1.0 / sums + stop_sd**2),
        views.length_m[best],
        views.length_sd[best],
        views.partial[best],
        views.diameter_m[best],
    )


def combined_length(
    length_m: NDArray[np.float64], length_sd: NDArray[np.float64], partial: NDArray[np.bool_]
) -> tuple[float, float] | None:
    """Give the length that all whole views of a fruit give together, and its standard deviation.

    Weighted by the inverse variance of the logarithm. Views of one camera share errors, so that
    half of the variance does not become less however many there are; and where views differ by
    more than they should (Birge's ratio above 1), the deviation is widened by that ratio.

    Parameters
    ----------
    length_m, length_sd : ndarray of float64, shape (M,)
        Lengths, NaN for none, and relative standard deviations.
    partial : ndarray of bool, shape (M,)
        Lower bounds, which are left out.

    Returns
    -------
    tuple of float, or None
        Length and standard deviation in metres; None without a whole view.

    Examples
    --------
    >>> found = combined_length(np.array([0.30, 0.31, 0.2]), np.full(3, 0.02),
    ...     np.array([False, False, True]))
    >>> [round(x, 4) for x in found]
    [0.305, 0.0061]
    """
    used = np.isfinite(length_m) & ~partial
    if not used.any():
        return None
    logs, weight = np.log(length_m[used]), 1.0 / length_sd[used] ** 2
    mean = float((weight * logs).sum() / weight.sum())
    alone = float(1.0 / weight.mean())
    variance = SHARED * alone + (1 - SHARED) / float(weight.sum())
    if len(logs) > 1:
        variance *= max(1.0, float((weight * (logs - mean) ** 2).sum()) / (len(logs) - 1))
    return float(np.exp(mean)), float(np.exp(mean)) * float(np.sqrt(variance))
