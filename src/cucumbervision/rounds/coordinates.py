"""A fruit's middle in the row's coordinates, and how sure each of them is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["PARTIAL_FLAGS", "is_partial", "middle_offset", "middle_sd"]

# What the flags call a fruit of which part is out of sight.
PARTIAL_FLAGS = frozenset({"cut-by-frame", "box-clipped", "end-hidden"})
HIDDEN_SHARE = 0.15
AXIS_SD_M = 0.005  # of a fitted tube's middle
SURFACE_SD_M = 0.010  # of the middle of what is seen: a box's or a mask's
SURFACE_DEPTH_SD_M = 0.020  # the surface lies a radius before the axis
PART_SHARE = 0.15  # of the length: how far the middle of a part is from the fruit's own
TURN_SD = 0.02  # radians: how far a camera is turned off its pose


def is_partial(flags: str, hidden_share: float | None) -> bool:
    """Say whether a fruit's length is no more than a lower bound.

    Examples
    --------
    >>> is_partial("sam-mask-small end-hidden", None), is_partial("", 0.05)
    (True, False)
    """
    return bool(PARTIAL_FLAGS & set(flags.split())) or (hidden_share or 0.0) > HIDDEN_SHARE


def middle_offset(middle_m: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give how far a fruit is from its camera along the row, upwards and into the row.

    Parameters
    ----------
    middle_m : ndarray of float64, shape (3,)
        Camera coordinates: right, down, away; metres.
    pose : ndarray of float64, shape (4, 4)
        As `poses.pose_matrix` gives it.

    Examples
    --------
    >>> from cucumbervision.rounds.poses import pose_matrix
    >>> middle_offset(np.array([0.1, 0.2, 0.7]), pose_matrix(3.0, -1)).tolist()
    [-0.1, -0.2, 0.7]
    """
    return np.asarray(pose[:3, :3] @ middle_m, np.float64)


def middle_sd(
    offset_m: NDArray[np.float64], *, tube: bool, partial: bool, length_m: float | None
) -> NDArray[np.float64]:
    """Give the standard deviations of a fruit's offset, metres, shape (3,).

    Parameters
    ----------
    offset_m : ndarray of float64, shape (3,)
        As `middle_offset` gives it.
    tube : bool
        Whether it is the middle of a fitted tube's axis.
    partial : bool
        Whether part of the fruit is hidden: then the middle is unsure along the fruit, which
        hangs.
    length_m : float, optional
        The length that is seen.

    Examples
    --------
    >>> sd = middle_sd(np.array([0.2, 0.0, 0.7]), tube=True, partial=True, length_m=0.3)
    >>> sd.round(3).tolist()
    [0.005, 0.045, 0.006]
    """
    across = AXIS_SD_M if tube else SURFACE_SD_M
    up = np.hypot(across, PART_SHARE * (length_m or 0.2)) if partial else across
    # Turning moves all fruit of a capture along alike, which their stop takes up; what is left
    # is the difference in depth between its left and its right.
    depth = np.hypot(across if tube else SURFACE_DEPTH_SD_M, TURN_SD * abs(float(offset_m[0])))
    return np.array([across, up, depth])
