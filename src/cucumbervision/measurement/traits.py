"""What a fitted tube says of its fruit: lengths, bend, diameters, volume, and how sure it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.tube import (
    arc_positions,
    axis_path,
    bending_direction,
    inner_arc_height,
    profile,
    thread_length,
    volume_of_profile,
)
from cucumbervision.measurement.result import TubeLengths, TubeTraits

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["tube_traits"]

SMALLEST_RADIUS_M = 1e-4


def tube_traits(centres_m: NDArray[np.float64], radii_m: NDArray[np.float64]) -> TubeTraits:
    """Measure a body of balls along a curve.

    Parameters
    ----------
    centres_m : ndarray of float64, shape (K, 3)
        Centres in order, camera coordinates, metres.
    radii_m : ndarray of float64, shape (K,)
        Their radii.

    Returns
    -------
    TubeTraits
        Of the balls' union.

    Examples
    --------
    A cylinder of radius 2 cm with round ends, its centres 16 cm long:

    >>> x = np.linspace(0, 0.16, 161)
    >>> traits = tube_traits(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), np.full(161, 0.02))
    >>> round(traits.lengths.centreline_m, 4), round(traits.lengths.thread_m, 4)
    (0.2, 0.2228)
    >>> by_hand = np.pi * 0.02**2 * 0.16 + 4 / 3 * np.pi * 0.02**3
    >>> round(1e6 * traits.volume_m3, 1), round(1e6 * by_hand, 1)  # millilitres
    (234.5, 234.6)
    >>> round(traits.diameter_max_m, 4), round(traits.tilt_deg, 1), traits.inner_arc_m
    (0.04, 0.0, 0.0)
    """
    radii = np.maximum(radii_m, SMALLEST_RADIUS_M)
    axis = axis_path(centres_m, radii)
    outward = bending_direction(axis)
    ends = axis[[0, -1]]
    chord = float(np.linalg.norm(ends[1] - ends[0]))
    along, diameter = profile(centres_m, radii)
    lengths = TubeLengths(
        centreline_m=float(arc_positions(axis)[-1]),
        thread_m=thread_length(centres_m, radii, outward),
        chord_m=chord,
    )
    deep = abs(float(ends[1, 2] - ends[0, 2])) / max(chord, 1e-9)
    return TubeTraits(
        lengths,
        inner_arc_height(centres_m, radii, ends, outward),
        along,
        diameter,
        volume_of_profile(along, diameter),
        float(np.rad2deg(np.arcsin(min(deep, 1.0)))),
        axis,
    )
