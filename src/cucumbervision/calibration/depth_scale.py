"""A camera's depth scale from a bar of known length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["LEAST_CAPTURES", "OUTLINE_SD_PX", "DepthScale", "fit_depth_scale"]

LEAST_CAPTURES = 3
OUTLINE_SD_PX = 0.7


@dataclass(frozen=True)
class DepthScale:
    """What the camera reads over what is.

    Parameters
    ----------
    value : float
        Read length over true length; depth is divided by it.
    standard_error : float
        Of `value`: the captures' scatter over the root of their number, and the outline's error at
        both ends, which repeats from capture to capture and does not average out.
    spread : float
        Standard deviation of one capture's ratio.
    captures : int
        Captures of the bar.
    """

    value: float
    standard_error: float
    spread: float
    captures: int


def fit_depth_scale(measured_m: ArrayLike, reference_m: float, pixel_m: float = 0.0) -> DepthScale:
    """Find the depth scale from captures of a bar.

    A depth camera that reads s times the true depth sees every point at (s x, s y, s z), since
    x = z (u - cx)/fx and y likewise; so every length reads s times too long, wherever the bar lies.

    Parameters
    ----------
    measured_m : array_like of float, shape (N,)
        Length of the bar in each capture, metres.
    reference_m : float
        Its true length, metres.
    pixel_m : float
        Size of a pixel at the bar's distance, metres, for the outline's error.

    Returns
    -------
    DepthScale

    Raises
    ------
    ValueError
        Below `LEAST_CAPTURES` captures, or if a length is not positive.

    Examples
    --------
    >>> scale = fit_depth_scale([0.504, 0.506, 0.505, 0.505], 0.500)
    >>> round(scale.value, 4), round(scale.standard_error, 5), scale.captures
    (1.01, 0.00082, 4)
    """
    ratios = np.asarray(measured_m, float) / reference_m
    if len(ratios) < LEAST_CAPTURES or not (ratios > 0).all():
        raise ValueError(f"a depth scale needs {LEAST_CAPTURES} captures of the bar")
    spread = float(ratios.std(ddof=1))
    ends = np.sqrt(2) * OUTLINE_SD_PX * pixel_m / reference_m
    error = float(np.hypot(spread / np.sqrt(len(ratios)), ends))
    return DepthScale(float(ratios.mean()), error, spread, len(ratios))
