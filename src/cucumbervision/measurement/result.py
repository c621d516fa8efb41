"""What a method says of one fruit: a length, or the named reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.perception.instances import Instance, MaskSource

__all__ = [
    "Fruit",
    "Length",
    "LengthKind",
    "Measurement",
    "Method",
    "Reason",
    "TubeFit",
    "TubeLengths",
    "TubeTraits",
]


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


class Method(StrEnum):
    """The six measuring methods."""

    M1 = "M1"
    M2 = "M2"
    M3 = "M3"
    M4 = "M4"
    M5 = "M5"
    M6 = "M6"


class LengthKind(StrEnum):
    """What a method's raw length is the length of."""

    BOX_CHORD = "box-chord"
    SURFACE_CHORD = "surface-chord"
    KEYPOINT_POLYLINE = "keypoint-polyline"
    SURFACE_ARC = "surface-arc"
    CENTRELINE = "centreline"


class Length(StrEnum):
    """The three lengths that people mean, which only a fitted tube yields."""

    THREAD = "thread"
    CENTRELINE = "centreline"
    CHORD = "chord"


class Reason(StrEnum):
    """Why a method gives no length; stable codes for tables."""

    OK = "ok"
    NO_MASK = "no-mask"
    NO_KEYPOINTS = "no-keypoints"
    NO_DEPTH = "no-depth"
    TOO_FEW_POINTS = "too-few-points"
    TOO_FEW_BINS = "too-few-bins"
    TOO_FEW_SAMPLES = "too-few-samples"
    ENDPOINT_MISSING = "endpoint-missing"
    OUTLINE_TOO_SHORT = "outline-too-short"
    NOT_A_TUBE = "not-a-tube"
    OUT_OF_RANGE = "out-of-range"


@dataclass(frozen=True, eq=False)
class Measurement:
    """One method on one fruit.

    Parameters
    ----------
    method : Method
        The method that was asked.
    length_m : float, optional
        Its length in metres; None when it gave none.
    kind : LengthKind, optional
        What that is the length of.
    reason : Reason
        'ok', or why there is no length.
    fallback : tuple of str
        What was tried before, as 'M3:too-few-points'; empty when the method itself measured.
    path_m : ndarray of float64, shape (K, 3), optional
        The line that was measured, camera coordinates in metres, end to end.
    measured_by : Method, optional
        The method that stood in, where this one fell back on another.
    tube : TubeLengths, optional
        The three lengths, where a tube was fitted.
    fit : TubeFit, optional
        The tube's other traits and how far to trust them, where one was fitted.
    """

    method: Method
    length_m: float | None = None
    kind: LengthKind | None = None
    reason: Reason = Reason.OK
    fallback: tuple[str, ...] = ()
    path_m: NDArray[np.float64] | None = None
    measured_by: Method | None = None
    tube: TubeLengths | None = None
    fit: TubeFit | None = None

    @property
    def own(self) -> bool:
        """Whether the method itself measured, without falling back on another."""
        return self.length_m is not None and self.measured_by is None


@dataclass(frozen=True, eq=False)
class Fruit:
    """One fruit, measured.

    Parameters
    ----------
    instance : Instance
        Where it is in the picture.
    measurements : mapping of Method to Measurement
        Every method that was run.
    selected : Measurement, optional
        The one that the selector took; None when nothing could be measured.
    reason : str
        Why that one, or why none: a code of `measurement.selector.Choice`.
    fallback : tuple of str
        The path of fallbacks that led there.
    flags : tuple of str
        What else to know: 'cut-by-frame', 'detector-mask', 'sam-mask-small', …
    mask : ndarray of bool, shape (H, W), optional
        The mask that was measured.
    mask_source : MaskSource, optional
        Who drew it.
    """

    instance: Instance
    measurements: dict[Method, Measurement]
    selected: Measurement | None
    reason: str
    fallback: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    mask: NDArray[np.bool_] | None = None
    mask_source: MaskSource | None = None
