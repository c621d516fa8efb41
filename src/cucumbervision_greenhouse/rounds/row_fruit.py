"""The fruit of a merged row: the representative measurement of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.methods.matching import pooled_length

if TYPE_CHECKING:
    from cucumbervision_greenhouse.rounds.merge import Merged
    from cucumbervision_greenhouse.rounds.row_views import Bools, Floats, Ints, RowViews


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
