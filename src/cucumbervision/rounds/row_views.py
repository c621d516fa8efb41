"""One row as arrays: where its stops were made, and which fruit each capture shows.

The row's frame: along the row as the operator's positions count, upwards, and into the row as
seen from side 0. Side 1 looks the other way, so that its depths enter negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["ALONG", "DEPTH", "UP", "RowStops", "RowViews", "pairs_within"]

ALONG, UP, DEPTH = 0, 1, 2


@dataclass(frozen=True, eq=False)
class RowStops:
    """The S stops of one row, both sides.

    Parameters
    ----------
    at_m : ndarray of float64, shape (S, 3)
        The camera as it was given: along, up, and into the row; metres. Up and into the row
        count from the usual camera of its side, so that they are 0 unless a pose says otherwise.
    sd_m : ndarray of float64, shape (S, 3)
        Standard deviations of these, metres.
    side : ndarray of int64, shape (S,)
        0, or 1 for stops made from the other aisle.
    reach : ndarray of float64, shape (S, 2)
        Tangents of half the field of view, along and up.
    """

    at_m: NDArray[np.float64]
    sd_m: NDArray[np.float64]
    side: NDArray[np.int64]
    reach: NDArray[np.float64]

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

    stop: NDArray[np.int64]
    capture: NDArray[np.int64]
    offset_m: NDArray[np.float64]
    offset_sd_m: NDArray[np.float64]
    length_m: NDArray[np.float64]
    length_sd: NDArray[np.float64]
    diameter_m: NDArray[np.float64]
    diameter_sd: NDArray[np.float64]
    partial: NDArray[np.bool_]
    score: NDArray[np.float64]
    view_score: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.stop)


def pairs_within(
    values: NDArray[np.float64], gate: float | NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
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
        own = np.broadcast_to(gate, values.shape)
        near = np.abs(values[i] - values[j]) <= np.maximum(own[i], own[j])
        return i[near], j[near]
    return i, j
