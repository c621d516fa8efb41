"""Compare the positions of two views of fruit, and combine the lengths of several views.

The similarity is the log likelihood ratio of multi-target tracking (Blackman & Popoli 1999, ch. 6):
the density of the difference between two views of one fruit, against the density of other fruit at
the second view. Densities have heavy tails, so that one outlier does not separate views that all
other readings join.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.arrays import Array, Mask

ALONG, UP, DEPTH = 0, 1, 2
"""Columns of positions in a row: along it, upwards, and into it."""

SURFACE_SD_M = 0.010
"""Standard deviation of the middle of what is seen: a box's or a mask's."""

SURFACE_DEPTH_SD_M = 0.020
"""The same in depth: the surface lies a radius before the axis."""

SHARED = 0.5
"""Share of a view's variance that is of errors that all views of a fruit have in common."""

_TAIL, _TAIL_FACTOR = 0.1, 5.0  # share of position errors that are five times as large: unseen ends

# Share of ends that are hidden without a flag, and their shift
_UNSEEN_END, _UNSEEN_END_M = 0.15, 0.05


@dataclass(frozen=True)
class Crowd:
    """The density of other fruit with which a view may be confused.

    Parameters
    ----------
    per_m : float
        Views of a capture per metre of row.
    up_m, depth_m : float
        Width of their distribution, upwards and into the row, metres.
    length_width, diameter_width : float
        Width of the logarithm of their lengths and diameters.
    """

    per_m: float
    up_m: float
    depth_m: float
    length_width: float
    diameter_width: float


def log_density(gap: ArrayLike, variance: ArrayLike) -> Array:
    """Return the log density of a gap under a normal distribution with heavy tails.

    Parameters
    ----------
    gap, variance : array_like of float
        Gap, and variance of the core of its distribution.

    Examples
    --------
    >>> float(log_density(0.0, 1.0).round(3)), float(log_density(6.0, 1.0).round(2))
    (-1.002, -5.55)
    """
    spread = np.asarray(variance, np.float64)
    square = np.square(gap) / spread
    core = (1 - _TAIL) * np.exp(-0.5 * square)
    tail = _TAIL / _TAIL_FACTOR * np.exp(-0.5 * square / _TAIL_FACTOR**2)
    return np.asarray(np.log(np.maximum(core + tail, 1e-300)) - 0.5 * np.log(2 * np.pi * spread))


def position_ratio(gap_m: Array, variance_m2: Array, crowd: Crowd) -> Array:
    """Return the log likelihood ratio of positions: same fruit against other fruit.

    Parameters
    ----------
    gap_m, variance_m2 : ndarray of float64, shape (..., 3)
        Difference of two views and its variance: along the row, up, into the row.
    crowd : Crowd
        Density of other fruit.

    Returns
    -------
    ndarray of float64, shape (...)
    """
    density = log_density(gap_m, variance_m2).sum(axis=-1)
    # A hidden end without a flag shifts the middle up or down by centimetres.
    up, variance = gap_m[..., UP], variance_m2[..., UP]
    end_variance = variance + _UNSEEN_END_M**2
    moved = -0.5 * (np.square(up) / end_variance + np.log(2 * np.pi * end_variance))
    end_density = log_density(up, variance)
    density += np.logaddexp(end_density, np.log(_UNSEEN_END) + moved) - end_density
    return np.asarray(density + np.log(crowd.up_m * crowd.depth_m / crowd.per_m), np.float64)


def pooled_length(length_m: Array, length_sd: Array, partial: Mask) -> tuple[float, float] | None:
    """Return the combined length of all whole views of a fruit, and its standard deviation.

    Logarithms are weighted by the inverse variance. Views of one camera share errors, so that half
    of the variance does not decrease with the number of views. If views differ more than expected
    (Birge ratio above 1), the standard deviation is multiplied by that ratio.

    Parameters
    ----------
    length_m, length_sd : ndarray of float64, shape (M,)
        Lengths, NaN for none, and relative standard deviations.
    partial : ndarray of bool, shape (M,)
        Lower bounds, which are excluded.

    Returns
    -------
    tuple of float, or None
        Length and standard deviation in metres; None without a whole view.

    Examples
    --------
    >>> pooled = pooled_length(np.array([0.30, 0.31, 0.2]), np.full(3, 0.02),
    ...     np.array([False, False, True]))
    >>> [round(x, 4) for x in pooled]
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
