"""What a fitted tube says: its lengths, its traits, and how far to trust them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["TubeFit", "TubeLengths", "TubeTraits"]


@dataclass(frozen=True)
class TubeLengths:
    """The lengths of a fitted tube, metres: along its axis, over its outer side, end to end."""

    centreline_m: float
    thread_m: float
    chord_m: float


@dataclass(frozen=True, eq=False)
class TubeTraits:
    """Lengths and shape of one tube.

    Parameters
    ----------
    lengths : TubeLengths
        Centreline, thread and chord.
    inner_arc_m : float
        Largest distance from the chord (pole to pole) to the inner edge, metres; 0 where the
        inner edge does not rise above the chord.
    along_m, diameter_m : ndarray of float64, shape (101,)
        The diameter along the axis from pole to pole, metres.
    volume_m3 : float
        Cubic metres.
    tilt_deg : float
        Angle of the chord out of the picture plane, 0 to 90 degrees.
    axis_m : ndarray of float64, shape (K, 3)
        The axis from pole to pole, camera coordinates, metres.
    """

    lengths: TubeLengths
    inner_arc_m: float
    along_m: NDArray[np.float64]
    diameter_m: NDArray[np.float64]
    volume_m3: float
    tilt_deg: float
    axis_m: NDArray[np.float64]

    @property
    def inner_arc_mm_per_10cm(self) -> float:
        """Inner arc height in mm for each 10 cm of chord (UNECE FFV-15)."""
        return 1000.0 * self.inner_arc_m / (10.0 * self.lengths.chord_m)

    @property
    def diameter_max_m(self) -> float:
        """Largest diameter, metres."""
        return float(self.diameter_m.max())

    @property
    def diameter_mean_m(self) -> float:
        """Mean diameter along the axis from pole to pole, metres."""
        return float(np.trapezoid(self.diameter_m, self.along_m) / self.along_m[-1])

    def mass_kg(self, density_kg_m3: float) -> float:
        """Give the mass at a density in kg per cubic metre."""
        return self.volume_m3 * density_kg_m3


@dataclass(frozen=True, eq=False)
class TubeFit:
    """A tube fitted to one fruit: its traits, and how far to trust them.

    Parameters
    ----------
    traits : TubeTraits
        Lengths, bend, diameters, volume, tilt.
    centreline_sd_m, thread_sd_m : float
        Standard deviations from the sensor's noise and the outline's error, scaled by what
        remains after the fit, metres. The camera's unknown depth scale is not in them.
    hidden_share : float
        Share of the tube's silhouette that something nearer covers, 0 to 1.
    explained : float
        Share of the mask's pixels that the tube's silhouette covers, 0 to 1.
    fill : float
        Share of the mask's pixels with a depth reading, 0 to 1.
    outline_rms_px, depth_rms_m : float
        Robust scatter of the outline about the tube's, pixels, and of the depth points about
        its surface, metres.
    ends_seen : tuple of bool
        Whether the outline shows the first and the last end of `traits.axis_m`.
    flags : tuple of str
        'end-hidden', 'end-on' (an end points so far along the view that little of it shows),
        'part-hidden', 'poor-fit', 'uncertain' (a standard deviation above 5 % of the length).
    """

    traits: TubeTraits
    centreline_sd_m: float
    thread_sd_m: float
    hidden_share: float
    explained: float
    fill: float
    outline_rms_px: float
    depth_rms_m: float
    ends_seen: tuple[bool, bool]
    flags: tuple[str, ...] = ()
