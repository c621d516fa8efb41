"""Errors of lengths against truth, with what was not measured counted as wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["Metrics", "percent_errors", "score"]


@dataclass(frozen=True)
class Metrics:
    """One method's errors over a set of captures.

    Parameters
    ----------
    count : int
        Captures, unmeasured ones included.
    measured : float
        Share measured, 0 to 1.
    mae_cm, rmse_cm : float
        Mean absolute and root mean square error; an unmeasured fruit counts as a length of 0.
    mape_percent, median_percent, worst_percent : float
        Mean, median and largest absolute relative error; an unmeasured fruit counts as 100 %.
    bias_percent : float
        Mean signed relative error of the measured ones; NaN if there are none.
    r2 : float
        Coefficient of determination; NaN if all true lengths are the same.
    pearson_r : float
        Correlation with the truth over the measured ones; NaN below three.
    """

    count: int
    measured: float
    mae_cm: float
    mape_percent: float
    rmse_cm: float
    r2: float
    pearson_r: float
    median_percent: float
    worst_percent: float
    bias_percent: float


def percent_errors(lengths_m: ArrayLike, truth_m: ArrayLike) -> NDArray[np.float64]:
    """Give each absolute relative error in percent; 100 where a length is NaN.

    Parameters
    ----------
    lengths_m, truth_m : array_like of float, shape (N,)
        Measured (NaN where not measured) and true lengths in metres.

    Examples
    --------
    >>> percent_errors([0.22, np.nan], [0.20, 0.20]).round(6).tolist()
    [10.0, 100.0]
    """
    lengths, truth = np.asarray(lengths_m, float), np.asarray(truth_m, float)
    return np.asarray(100 * np.abs(np.nan_to_num(lengths) - truth) / truth)


def score(lengths_m: ArrayLike, truth_m: ArrayLike) -> Metrics:
    """Give the paper's metrics (Eqs. 7 to 10), refusing being no way out.

    Parameters
    ----------
    lengths_m, truth_m : array_like of float, shape (N,)
        Measured (NaN where not measured) and true lengths in metres, N >= 1.

    Raises
    ------
    ValueError
        If there is nothing to score or a true length is not positive.

    Examples
    --------
    >>> m = score([0.11, 0.19], [0.10, 0.20])
    >>> round(m.mae_cm, 6), round(m.mape_percent, 6), round(m.r2, 6)
    (1.0, 7.5, 0.96)
    """
    lengths, truth = np.asarray(lengths_m, float), np.asarray(truth_m, float)
    if not truth.size or not (truth > 0).all():
        raise ValueError("true lengths must be positive, and at least one")
    known = np.isfinite(lengths)
    error_cm = 100 * (np.nan_to_num(lengths) - truth)
    percent = percent_errors(lengths, truth)
    spread = float(((truth - truth.mean()) ** 2).sum())
    r2 = 1 - float((error_cm**2).sum()) / (1e4 * spread) if spread > 0 else np.nan
    enough = known.sum() >= 3 and np.ptp(truth[known]) > 0 and np.ptp(lengths[known]) > 0
    return Metrics(
        count=int(truth.size),
        measured=float(known.mean()),
        mae_cm=float(np.abs(error_cm).mean()),
        mape_percent=float(percent.mean()),
        rmse_cm=float(np.sqrt((error_cm**2).mean())),
        r2=float(r2),
        pearson_r=float(np.corrcoef(lengths[known], truth[known])[0, 1]) if enough else np.nan,
        median_percent=float(np.median(percent)),
        worst_percent=float(percent.max()),
        bias_percent=(
            float((100 * (lengths[known] / truth[known] - 1)).mean()) if known.any() else np.nan
        ),
    )
