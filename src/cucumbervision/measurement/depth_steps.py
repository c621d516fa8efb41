"""Detect depth that was stored in steps as coarse as a fruit; pure functions of arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LEVEL_SAMPLES = 10_000
_LEVEL_READINGS, _LEVELS_SHARE = 3, 0.9  # of a level, and on levels; the rest may be mixtures
# Of the distance. Depth in millimetres has 0.8 % at 0.12 m, a Kinect 0.6 % at 2 m, a D435 0.2 %.
_COARSE_STEP = 0.012
_FRUIT_LEVELS, _PICTURE_LEVELS = 3, 4  # needed to tell; drawn pictures of flat things have fewer
_NEAR_M, _PICTURE_STRIDE = 2.0, 4  # where the steps of a picture are looked at
_EIGHT_BITS_M, _MILLIMETRE_M = 0.2555, 0.00099


def has_coarse_steps(depth_m: NDArray[np.float32], readings_m: NDArray[np.float32]) -> bool:
    """Return whether depth has too few values for a round body, as after 8 bits.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 for no reading.
    readings_m : ndarray of float32, shape (N,)
        Those of the fruit, at least one.

    Examples
    --------
    >>> round_body_m = np.linspace(0.48, 0.5, 2000, dtype=np.float32).reshape(20, 100).round(3)
    >>> has_coarse_steps(round_body_m, round_body_m.ravel())
    False
    >>> whole_centimetres = round_body_m.round(2)
    >>> has_coarse_steps(whole_centimetres, whole_centimetres.ravel())
    True
    """
    return _is_coarse(depth_m, readings_m) or _has_eight_bits(depth_m, readings_m)


def _is_coarse(depth_m: NDArray[np.float32], readings_m: NDArray[np.float32]) -> bool:
    """Return whether a fruit's readings are too few values for a round body.

    Where steps are as thick as the fruit, those of the picture tell.
    """
    levels_m, least = _levels(readings_m), _FRUIT_LEVELS
    if 0 < len(levels_m) < least:
        picture_m = depth_m[::_PICTURE_STRIDE, ::_PICTURE_STRIDE]
        levels_m = _levels(picture_m[(picture_m > 0) & (picture_m < _NEAR_M)])
        least = _PICTURE_LEVELS
    if len(levels_m) < least:
        return False
    return float(np.median(np.diff(levels_m) / levels_m[1:])) > _COARSE_STEP


def _has_eight_bits(depth_m: NDArray[np.float32], readings_m: NDArray[np.float32]) -> bool:
    """Return whether a picture holds 0 to 255 mm, as one of 8 bits that was saved with 16.

    Cameras that read so near store tenths of a millimetre.
    """
    if readings_m.max() > _EIGHT_BITS_M or depth_m.max() > _EIGHT_BITS_M:
        return False
    levels_m = _levels(readings_m)
    return len(levels_m) > 1 and float(np.diff(levels_m).min()) >= _MILLIMETRE_M


def _levels(readings_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values that nearly all readings have, ascending; empty if there are none."""
    spacing = max(1, readings_m.size // _LEVEL_SAMPLES)
    levels_m, counts = np.unique(readings_m[::spacing], return_counts=True)
    common = counts >= _LEVEL_READINGS
    if counts[common].sum() < _LEVELS_SHARE * counts.sum():
        common[:] = False
    return np.asarray(levels_m[common], np.float32)
