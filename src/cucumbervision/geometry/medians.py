"""Medians that skip what is no reading."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["valid_median"]


def valid_median(values: NDArray[Any], valid: NDArray[np.bool_], axis: int = 0) -> NDArray[Any]:
    """Return the median along an axis over the valid entries only.

    Parameters
    ----------
    values : ndarray of float
        Any shape.
    valid : ndarray of bool
        The shape of `values`; False where an entry does not count.
    axis : int
        The axis that vanishes.

    Returns
    -------
    ndarray of float
        The dtype of `values`; NaN where no entry is valid. An even count gives the mean of the
        two middle entries.

    Examples
    --------
    >>> values = np.array([[1.0, 9.0, 2.0, 4.0], [3.0, 3.0, 3.0, 3.0]])
    >>> valid = np.array([[True, False, True, True], [False] * 4])
    >>> valid_median(values, valid, axis=1)
    array([ 2., nan])
    """
    # Invalid entries sort to the end, so the middle of the valid ones is found by their count.
    ordered = np.sort(np.where(valid, values, np.inf), axis=axis)
    count = valid.sum(axis=axis, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis)
    with np.errstate(invalid="ignore"):  # inf - inf where nothing is valid
        middle = low + (high - low) / 2
    return np.where(count > 0, middle, np.nan).squeeze(axis).astype(values.dtype)
