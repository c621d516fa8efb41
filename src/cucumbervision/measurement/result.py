"""Result of one fruit: each method's measurement, and the chosen length with its interval."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING

from cucumbervision.measurement.flags import Flag, is_lower_bound

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.instances.end_crops import EndLook
    from cucumbervision.instances.instance import Instance, MaskSource
    from cucumbervision.measurement.hidden_end import HiddenLength
    from cucumbervision.measurement.pose import FruitPose
    from cucumbervision.measurement.traits import TubeLengths, TubeTraits


class MethodName(StrEnum):
    """The package's own measuring methods, by name."""

    M1 = "M1"
    M2 = "M2"
    M3 = "M3"
    M4 = "M4"
    M5 = "M5"
    M6 = "M6"


class LengthDefinition(StrEnum):
    """The three definitions of a fruit's length, which only a fitted tube yields."""

    THREAD = "thread"
    CENTRELINE = "centreline"
    CHORD = "chord"


class LengthKind(StrEnum):
    """What a method's raw length is the length of."""

    BOX_CHORD = "box-chord"
    SURFACE_CHORD = "surface-chord"
    KEYPOINT_POLYLINE = "keypoint-polyline"
    SURFACE_ARC = "surface-arc"
    CENTRELINE = "centreline"


class IntervalBasis(StrEnum):
    """What the interval of a length was learnt from."""

    SIMULATED = "simulated"
    OWN_TRUTH = "own truth"


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
    ALONG_THE_VIEW = "along-the-view"
    OUT_OF_RANGE = "out-of-range"


class Selector(StrEnum):
    """How one measurement is chosen.

    `PAPER` follows the paper's decisions and counts only SAM's or the data set's own masks;
    `BEST` lets the detector's mask stand in, and takes M6 first where it was run.
    """

    BEST = "best"
    PAPER = "paper"


class Choice(StrEnum):
    """Which decision the selector took; stable codes for tables."""

    DENSE_MASK = "mask-points-ge-100"
    SPARSE_MASK = "mask-points-lt-100"
    ELONGATED_BOX = "no-mask-box-elongated"
    COMPACT_BOX = "no-mask-box-compact"
    NO_DEPTH = "no-depth"
    NOTHING = "not-measured"
    IMPLAUSIBLE = "implausible-length"
    IMPLAUSIBLE_DIAMETER = "implausible-diameter"
    WAITING = "not-selected"
    SEVERAL_VIEWS = "several-views"


INTERVAL_Z = 1.6448536269514722  # standard normal quantile of the ends of 90 % intervals


@dataclass(frozen=True)
class Length:
    """A length, with the interval that it is known to, which always holds the length.

    The models of intervals know how far a method reads short, above all of a fruit that goes on
    out of sight or of a box's diagonal: what they expect may lie beyond the length as measured.
    The interval then begins or ends at the length.

    Parameters
    ----------
    value_m : float
        Metres.
    kind : LengthDefinition or LengthKind
        What it is the length of.
    low_m, high_m : float, optional
        The 90 % interval, metres; None where none is known.
    interval_of : LengthDefinition, optional
        Which length the interval is about: `kind` itself, or for a raw length the centreline.
    basis : IntervalBasis, optional
        What the interval was learnt from.

    Examples
    --------
    >>> seen = Length(0.171, low_m=0.198, high_m=0.248)
    >>> seen.low_m, seen.high_m
    (0.171, 0.248)
    """

    value_m: float
    kind: LengthDefinition | LengthKind = LengthDefinition.CENTRELINE
    low_m: float | None = None
    high_m: float | None = None
    interval_of: LengthDefinition | None = None
    basis: IntervalBasis | None = None

    def __post_init__(self) -> None:
        if self.low_m is None or self.high_m is None or not self.low_m <= self.high_m:
            return
        object.__setattr__(self, "low_m", min(self.low_m, self.value_m))
        object.__setattr__(self, "high_m", max(self.high_m, self.value_m))

    @property
    def sides(self) -> tuple[float, float, float] | None:
        """The median, and the standard deviations of the logarithm below and above it.

        The ends of the interval are taken as quantiles and the length as the median (the middle of
        the interval's logarithm if it is one of the ends); each side is half a normal distribution
        of the logarithm. None where no interval is known.

        Examples
        --------
        >>> [round(one, 4) for one in Length(0.252, low_m=0.246, high_m=0.258).sides]
        [0.252, 0.0147, 0.0143]
        """
        if not (self.low_m and self.high_m and 0 < self.low_m <= self.high_m < math.inf):
            return None
        inside = self.low_m < self.value_m < self.high_m
        median = self.value_m if inside else math.sqrt(self.low_m * self.high_m)
        below, above = math.log(median / self.low_m), math.log(self.high_m / median)
        return median, below / INTERVAL_Z, above / INTERVAL_Z

    @property
    def relative_sd(self) -> float | None:
        """Standard deviation of the logarithm by the interval; None where that is not known.

        Examples
        --------
        >>> round(Length(0.30, low_m=0.29, high_m=0.31).relative_sd, 4)
        0.0203
        """
        return None if self.sides is None else (self.sides[1] + self.sides[2]) / 2


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
    ends_covariance : ndarray of float64, shape (2, 6, 6)
        Covariance of each end's place (metres) and of the unit vector out of the fruit there.
    ends_open : tuple of float
        Share of what lies just beyond either end that is clearly behind it, 0 to 1.
    flags : tuple of Flag
        'end-hidden', 'end-on' (an end points so far along the view that little of it shows),
        'part-hidden', 'poor-fit', 'uncertain' (a standard deviation above 5 % of the length).
    hidden_length : HiddenLength, optional
        The whole fruit's centreline, where one end is hidden by something in the picture;
        `traits` are those of what is seen.
    looks : tuple of EndLook, optional
        What the first and the last end look like, where a network looked at them.
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
    ends_covariance: NDArray[np.float64]
    ends_open: tuple[float, float]
    flags: tuple[Flag, ...] = ()
    hidden_length: HiddenLength | None = None
    looks: tuple[EndLook, EndLook] | None = None


@dataclass(frozen=True, eq=False)
class Measurement:
    """One method on one fruit.

    Parameters
    ----------
    method : MethodName
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
        The line that was measured, camera coordinates in metres; of a measured fruit it begins
        at the stem end.
    measured_by : MethodName, optional
        The method that stood in, where this one fell back on another.
    fit : TubeFit, optional
        The tube, where one was fitted.
    """

    method: MethodName
    length_m: float | None = None
    kind: LengthKind | None = None
    reason: Reason = Reason.OK
    fallback: tuple[str, ...] = ()
    path_m: NDArray[np.float64] | None = field(default=None, repr=False)
    measured_by: MethodName | None = None
    fit: TubeFit | None = field(default=None, repr=False)

    @property
    def own(self) -> bool:
        """Whether the method itself measured, without falling back on another."""
        return self.length_m is not None and self.measured_by is None

    @property
    def source(self) -> MethodName:
        """The method whose length this is."""
        return self.measured_by or self.method

    @property
    def tube(self) -> TubeLengths | None:
        """The three lengths, where a tube was fitted."""
        return None if self.fit is None else self.fit.traits.lengths


@dataclass(frozen=True, eq=False)
class FruitMeasurement:
    """Everything that is known of one fruit of one capture.

    Parameters
    ----------
    instance : Instance
        Where it is in the picture.
    measurements : mapping of MethodName to Measurement
        Every method that was run.
    selected : Measurement, optional
        The one that the selector took; None when nothing could be measured.
    reason : Choice
        Why that one, or why none.
    fallback : tuple of str
        The path of fallbacks that led there.
    flags : tuple of Flag
        What else to know, in the order in which it was found.
    mask : ndarray of bool, shape (H, W), optional
        The mask that was measured.
    mask_source : MaskSource, optional
        Who drew it.
    length : Length, optional
        The fruit's length with its interval, calibrated where a site's calibration covers it;
        None when nothing could be measured.
    raw_length : Length, optional
        The length before the calibration, where one was applied.
    calibration : str, optional
        Name and hash of the site's calibration that was applied to depth or length.
    distance_m : float, optional
        Median depth of the mask, or of the box without one, metres; None without a valid reading.
    fill : float, optional
        Share of these pixels with a valid depth reading, 0 to 1.
    pose : FruitPose, optional
        Where it is in space, and where to cut; None where no tube was fitted.
    lengths : mapping of str to Length
        Every method's length with its interval, as `calibration_key` names them: 'M1' to 'M6', and
        'M6 thread' and 'M6 chord'. Without a site's calibration.
    """

    instance: Instance
    measurements: Mapping[MethodName, Measurement]
    selected: Measurement | None
    reason: Choice
    fallback: tuple[str, ...] = ()
    flags: tuple[Flag, ...] = ()
    mask: NDArray[np.bool_] | None = None
    mask_source: MaskSource | None = None
    length: Length | None = None
    raw_length: Length | None = None
    calibration: str | None = None
    distance_m: float | None = None
    fill: float | None = None
    pose: FruitPose | None = None
    lengths: Mapping[str, Length] = field(default_factory=dict)

    def __repr__(self) -> str:
        words = f"not measured: {self.reason}"
        if self.length is not None:
            words = f"{100 * self.length.value_m:.1f} cm {self.length.kind} by {self.method}"
        return f"<FruitMeasurement: {words}>"

    @property
    def method(self) -> MethodName | None:
        """The method whose length stands."""
        return None if self.selected is None else self.selected.source

    @property
    def fit(self) -> TubeFit | None:
        """The fitted tube, where that method fits one."""
        return None if self.selected is None else self.selected.fit

    @property
    def traits(self) -> TubeTraits | None:
        """Lengths, bend, diameters, volume and tilt of the fitted tube."""
        return None if self.fit is None else self.fit.traits

    @property
    def at_least(self) -> bool:
        """Whether the fruit goes on out of sight, so that its length is a lower bound."""
        return is_lower_bound(self.flags)

    def flagged(self, *flags: Flag) -> Self:
        """Return the same with further flags."""
        new = tuple(flag for flag in flags if flag not in self.flags)
        return replace(self, flags=(*self.flags, *new))


def calibration_key(method: MethodName, kind: LengthDefinition | LengthKind) -> str:
    """Return what calibrations and interval models call a method's length.

    Examples
    --------
    >>> calibration_key(MethodName.M5, LengthKind.SURFACE_ARC)
    'M5'
    >>> calibration_key(MethodName.M6, LengthDefinition.THREAD)
    'M6 thread'
    >>> calibration_key(MethodName.M6, LengthDefinition.CENTRELINE)
    'M6'
    """
    is_further = method is MethodName.M6 and kind in (
        LengthDefinition.THREAD,
        LengthDefinition.CHORD,
    )
    return f"{method} {kind}" if is_further else str(method)
