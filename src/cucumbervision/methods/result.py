"""Result of one fruit: each method's measurement, and the chosen length with its interval."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator, TypeAdapter, WithJsonSchema

from cucumbervision.errors import PluginError
from cucumbervision.fruit.crops import EndLook
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.flags import Flag, is_lower_bound


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
    """Quantity that a method's raw length measures."""

    BOX_CHORD = "box-chord"
    SURFACE_CHORD = "surface-chord"
    KEYPOINT_POLYLINE = "keypoint-polyline"
    SURFACE_ARC = "surface-arc"
    CENTRELINE = "centreline"


class IntervalBasis(StrEnum):
    """Data from which the interval of a length was learnt."""

    SIMULATED = "simulated"
    OWN_TRUTH = "own truth"


class Reason(StrEnum):
    """Reason why a method gives no length; stable codes for tables."""

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
    PLUGIN_FAILED = "plugin-failed"


class Selector(StrEnum):
    """Rule for choosing one measurement.

    `PAPER` follows the paper's decisions and counts only SAM's or the data set's own masks;
    `BEST` also uses the detector's mask, and prefers M6 if it was run.
    """

    BEST = "best"
    PAPER = "paper"


class Choice(StrEnum):
    """Decision of the selector; stable codes for tables."""

    DENSE_MASK = "mask-points-ge-100"
    SPARSE_MASK = "mask-points-lt-100"
    ELONGATED_BOX = "no-mask-box-elongated"
    COMPACT_BOX = "no-mask-box-compact"
    NO_DEPTH = "no-depth"
    NOTHING = "not-measured"
    IMPLAUSIBLE = "implausible-length"
    IMPLAUSIBLE_DIAMETER = "implausible-diameter"
    WAITING = "not-selected"


INTERVAL_Z = 1.6448536269514722  # standard normal quantile of the ends of 90 % intervals

UNKNOWN_SD = 0.08
"""Relative standard deviation that a length without an interval counts with."""


@dataclass(frozen=True)
class Length:
    """A length with its interval, which always contains the length.

    Interval models correct for methods that read short, such as the diagonal of a box, and for
    fruit that continue out of sight. The corrected interval may not contain the measured length; it
    is then extended to begin or end at the length.

    Parameters
    ----------
    value_m : float
        Metres.
    kind : LengthDefinition or LengthKind
        Measured quantity.
    low_m, high_m : float, optional
        The 90 % interval, metres; None if unknown.
    interval_of : LengthDefinition, optional
        Quantity of the interval: `kind` itself, or the centreline for a raw length.
    basis : IntervalBasis, optional
        Data from which the interval was learnt.

    Examples
    --------
    >>> length = Length(0.171, low_m=0.198, high_m=0.248)
    >>> length.low_m, length.high_m
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

        The ends of the interval are taken as quantiles and the length as the median (or the middle
        of the logarithmic interval if the length is one of the ends). Each side is half a normal
        distribution of the logarithm. None without an interval.

        Examples
        --------
        >>> [round(side, 4) for side in Length(0.252, low_m=0.246, high_m=0.258).sides]
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
        """Standard deviation of the logarithm from the interval; None without an interval.

        Examples
        --------
        >>> round(Length(0.30, low_m=0.29, high_m=0.31).relative_sd, 4)
        0.0203
        """
        return None if self.sides is None else (self.sides[1] + self.sides[2]) / 2


# A spindle is thinner towards its ends than cucumbers are: mean over largest diameter. Its end may
# be out of sight beyond this angle along the view, the slope of its sides included.
_SPINDLE, _SPINDLE_END_DEG = 0.82, 55.0


@dataclass(frozen=True)
class TubeLengths:
    """The lengths of a fitted tube, metres: along its axis, over its outer side, end to end."""

    centreline_m: float
    thread_m: float
    chord_m: float

    def of(self, definition: LengthDefinition) -> float:
        """Return the length of that definition, metres."""
        value: float = getattr(self, f"{definition}_m")
        return value


@dataclass(frozen=True, eq=False, kw_only=True)
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
        return 100.0 * self.inner_arc_m / self.lengths.chord_m

    @property
    def diameter_max_m(self) -> float:
        """Largest diameter, metres."""
        return float(self.diameter_m.max())

    @property
    def diameter_mean_m(self) -> float:
        """Mean diameter along the axis from pole to pole, metres."""
        return float(np.trapezoid(self.diameter_m, self.along_m) / self.along_m[-1])

    @property
    def may_hide_an_end(self) -> bool:
        """Whether it is a spindle, as bananas are, with an end that points away from the camera.

        Such an end can lie behind the body's own middle: the tube fits what is seen well, and ends
        too early.
        """
        if self.diameter_mean_m > _SPINDLE * self.diameter_max_m:
            return False
        tenth, length_m = len(self.axis_m) // 10, self.along_m[-1]
        for axis, width in (
            (self.axis_m, self.diameter_m),
            (self.axis_m[::-1], self.diameter_m[::-1]),
        ):
            step = axis[0] - axis[tenth]
            sine = step @ axis[0] / np.linalg.norm(step) / np.linalg.norm(axis[0])
            away = np.arcsin(np.clip(sine, -1.0, 1.0))  # rounding, where an end is on the view
            slope = np.arctan((width[30] - width[10]) / 2 / (0.2 * length_m))
            if np.rad2deg(away + slope) > _SPINDLE_END_DEG:
                return True
        return False


@dataclass(frozen=True)
class TraitValue:
    """The value of a trait, or why it is withheld.

    Parameters
    ----------
    value : float, optional
        In SI units; None where it is withheld.
    reason : str
        Why it is withheld, as a short code: 'too-few-pixels'.
    error : PluginError, optional
        Why another package's trait failed.
    """

    value: float | None
    reason: str = ""
    error: PluginError | None = None


@dataclass(frozen=True)
class HiddenLength:
    """The length of a fruit with a hidden end.

    Parameters
    ----------
    seen_m : float
        Visible length, metres.
    median_m, low_m, high_m : float
        Median and 90 % interval of the whole length, metres.
    """

    seen_m: float
    median_m: float
    low_m: float
    high_m: float


def _array(digits: int, *shape: int | None) -> Any:
    """Return the pydantic type of an array of that shape as JSON; None for any size."""
    schema: dict[str, Any] = {"type": "number"}
    for size in reversed(shape):
        limits = {} if size is None else {"minItems": size, "maxItems": size}
        schema = {"type": "array", "items": schema, **limits}
    write = PlainSerializer(lambda values: np.round(values, digits).tolist())
    return PlainValidator(np.asarray), write, WithJsonSchema(schema)


_Point = Annotated[NDArray[np.float64], *_array(5, 3)]
_Line = Annotated[NDArray[np.float64], *_array(5, None, 3)]
_Values = Annotated[NDArray[np.float64], *_array(5, None)]
_Matrix = Annotated[NDArray[np.float64], *_array(12, 3, 3)]


def _describe(schema: dict[str, Any], described: type[Any]) -> None:
    schema["description"] = (described.__doc__ or "").partition("\n")[0]


FIRST_LINE = ConfigDict(json_schema_extra=_describe)
"""A class's `__pydantic_config__`: its JSON Schema has the first line of its docstring alone."""


class Part(StrEnum):
    """Parts of a fruit that may be out of sight."""

    STEM = "stem"
    BLOSSOM = "blossom"
    BODY = "body"
    CUT = "cut"


@dataclass(frozen=True, eq=False, kw_only=True)
class FruitPose:
    """A fruit in space: metres, in coordinates of the camera (x right, y down, z forward).

    Parameters
    ----------
    frame : str
        Name of the coordinates: that of the source, as in ROS, otherwise
        'camera_color_optical_frame'.
    stem_m, blossom_m : ndarray of float64, shape (3,)
        The two ends; for a hidden end, the end of the visible part.
    stem_confidence : float
        Probability that `stem_m` is the stem end, 0.5 to 1. At 0.5 the ends are not distinguished,
        and the upper end in the picture is taken.
    centre_m : ndarray of float64, shape (3,)
        The middle of the axis.
    axis_m : ndarray of float64, shape (33, 3)
        The axis from the stem's end to the blossom's, evenly spaced.
    radius_m : ndarray of float64, shape (33,)
        The radius at each of these points.
    direction : ndarray of float64, shape (3,)
        Unit vector along the axis at the stem's end, out of the fruit.
    cut_m : ndarray of float64, shape (3,), optional
        The place to cut, on the extension of the axis beyond the stem end; None if that end is
        hidden.
    cut_covariance_m2 : ndarray of float64, shape (3, 3), optional
        Its covariance, square metres.
    covered : tuple of Part
        Hidden parts: an end, more than a tenth of the body, the place to cut.

    Examples
    --------
    >>> from cucumbervision import example_captures, measure
    >>> pose = measure(example_captures() / "simulated-row-a", instances="dataset").fruit[0].pose
    >>> bool(pose.stem_m[1] < pose.blossom_m[1]), [str(part) for part in pose.covered]
    (True, [])
    >>> round(float(np.linalg.norm(pose.cut_m - pose.stem_m)), 3)
    0.02
    """

    __pydantic_config__: ClassVar = FIRST_LINE

    frame: str
    stem_m: Annotated[_Point, Field(description="stem end")]
    blossom_m: Annotated[_Point, Field(description="blossom end")]
    stem_confidence: Annotated[float, Field(description="probability that this end is the stem's")]
    centre_m: Annotated[_Point, Field(description="middle of the axis")]
    axis_m: Annotated[_Line, Field(description="the axis, from the stem end")]
    radius_m: Annotated[_Values, Field(description="the radius at each point of the axis")]
    direction: Annotated[_Point, Field(description="out of the fruit at the stem end, unit")]
    cut_m: Annotated[_Point | None, Field(description="place to cut")]
    cut_covariance_m2: Annotated[_Matrix | None, Field(description="its covariance")]
    covered: Annotated[tuple[Part, ...], Field(description="parts that are out of sight")]

    def as_json(self) -> dict[str, Any]:
        """Return the pose as JSON values: metres to 10 micrometres."""
        values: dict[str, Any] = _POSE.dump_python(self, mode="json")
        return values

    def __repr__(self) -> str:
        stem = ", ".join(f"{value:.3f}" for value in self.stem_m)
        return f"<FruitPose: stem at ({stem}) m, {self.stem_confidence:.0%} sure>"


_POSE = TypeAdapter(FruitPose)


@dataclass(frozen=True, eq=False, kw_only=True)
class TubeFit:
    """A tube fitted to one fruit: its traits and their quality.

    Parameters
    ----------
    traits : TubeTraits
        Lengths, bend, diameters, volume, tilt.
    centreline_sd_m, thread_sd_m : float
        Standard deviations from the sensor's noise and the outline's error, scaled by the residuals
        of the fit, metres. They exclude the error of the camera's depth scale.
    hidden_share : float
        Share of the tube's silhouette that is hidden by nearer objects, 0 to 1.
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
        Share of the readings just beyond each end that are clearly behind it, 0 to 1.
    flags : tuple of Flag
        'end-hidden', 'end-on' (an end points so far along the view that little of it shows),
        'part-hidden', 'poor-fit', 'uncertain' (a standard deviation above 5 % of the length).
    hidden_length : HiddenLength, optional
        Length of the whole centreline if one end is hidden by an object in the picture; `traits`
        describe the visible part.
    looks : tuple of EndLook, optional
        Evaluation of the first and the last end, if a network evaluated them.
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
    method : str
        Name of the requested method.
    length_m : float, optional
        Length in metres; None if the method failed.
    kind : LengthKind, optional
        Quantity that the length measures.
    reason : Reason
        'ok', or why there is no length.
    fallback : tuple of str
        Failed methods, such as 'M3:too-few-points'; empty if the method itself succeeded.
    path_m : ndarray of float64, shape (K, 3), optional
        The measured line, camera coordinates in metres; in the result of a fruit it begins at the
        stem end.
    measured_by : str, optional
        The method that was used instead, after a fallback.
    fit : TubeFit, optional
        The fitted tube, if any.
    error : PluginError, optional
        Why a method of another package failed.
    """

    method: str
    length_m: float | None = None
    kind: LengthKind | None = None
    reason: Reason = Reason.OK
    fallback: tuple[str, ...] = ()
    path_m: NDArray[np.float64] | None = field(default=None, repr=False)
    measured_by: str | None = None
    fit: TubeFit | None = field(default=None, repr=False)
    error: PluginError | None = None

    @property
    def is_direct(self) -> bool:
        """Whether the method itself succeeded, without a fallback."""
        return self.length_m is not None and self.measured_by is None

    @property
    def source(self) -> str:
        """The method that measured the length."""
        return self.measured_by or self.method

    @property
    def tube(self) -> TubeLengths | None:
        """The three lengths of the fitted tube, or None."""
        return None if self.fit is None else self.fit.traits.lengths


@dataclass(frozen=True, eq=False)
class Fruit:
    """The complete result of one fruit in one capture.

    Parameters
    ----------
    instance : Instance
        The detection in the picture.
    measurements : mapping of str to Measurement
        Measurements of all methods that were run.
    selected : Measurement, optional
        The chosen measurement; None if nothing could be measured.
    reason : Choice
        Reason for the choice, or why nothing was chosen.
    fallback : tuple of str
        Methods that failed before, with their reasons.
    flags : tuple of Flag
        Flags, in the order of detection.
    mask : ndarray of bool, shape (H, W), optional
        The measured mask.
    mask_source : MaskSource, optional
        Source of the mask.
    length : Length, optional
        The fruit's length with its interval, corrected by the calibration of the site if it
        applies; None if nothing could be measured.
    raw_length : Length, optional
        The length before the correction, if one was applied.
    calibration : str, optional
        Name and hash of the site's calibration that was applied to depth or length.
    distance_m : float, optional
        Median depth of the mask, or of the box without one, metres; None without a valid reading.
    fill : float, optional
        Share of these pixels with a valid depth reading, 0 to 1.
    pose : FruitPose, optional
        Pose and cut place; None without a fitted tube.
    lengths : mapping of str to Length
        Length and interval of every method, uncorrected, by `calibration_key`: 'M1' to 'M6',
        'M6 thread' and 'M6 chord'.
    trait_values : mapping of str to TraitValue
        Values of the traits by name, or why they are withheld.
    """

    instance: Instance
    measurements: Mapping[str, Measurement]
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
    trait_values: Mapping[str, TraitValue] = field(default_factory=dict)

    def __repr__(self) -> str:
        words = f"not measured: {self.reason}"
        if self.length is not None:
            words = f"{100 * self.length.value_m:.1f} cm {self.length.kind} by {self.method}"
        return f"<Fruit: {words}>"

    @property
    def errors(self) -> tuple[PluginError, ...]:
        """Why methods and traits of other packages failed."""
        answers: list[Measurement | TraitValue] = [*self.measurements.values()]
        answers += self.trait_values.values()
        return tuple(answer.error for answer in answers if answer.error is not None)

    @property
    def withheld(self) -> str:
        """The traits without a value, and why."""
        values = self.trait_values.items()
        return " ".join(f"{name}:{value.reason}" for name, value in values if value.reason)

    @property
    def method(self) -> str | None:
        """The method of the chosen length."""
        return None if self.selected is None else self.selected.source

    @property
    def fit(self) -> TubeFit | None:
        """The fitted tube of the chosen measurement, or None."""
        return None if self.selected is None else self.selected.fit

    @property
    def traits(self) -> TubeTraits | None:
        """Lengths, bend, diameters, volume and tilt of the fitted tube."""
        return None if self.fit is None else self.fit.traits

    @property
    def at_least(self) -> bool:
        """Whether the fruit continues out of sight, so that its length is a lower bound."""
        return is_lower_bound(self.flags)

    def flagged(self, *flags: Flag) -> Self:
        """Return a copy with additional flags."""
        new = tuple(flag for flag in flags if flag not in self.flags)
        return replace(self, flags=(*self.flags, *new))

    def unflagged(self, flag: Flag) -> Self:
        """Return a copy without a flag."""
        return replace(self, flags=tuple(other for other in self.flags if other is not flag))


if TYPE_CHECKING:
    FruitMeasurement = Fruit
else:

    def __getattr__(name: str) -> object:
        """Return `Fruit` by its name of 0.1.0, until 0.3.0."""
        if name == "FruitMeasurement":
            warnings.warn(
                "FruitMeasurement is called Fruit, and goes with 0.3.0",
                DeprecationWarning,
                stacklevel=2,
            )
            return Fruit
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def calibration_key(method: str, kind: LengthDefinition | LengthKind) -> str:
    """Return the key of a method's length in calibrations and interval models.

    Examples
    --------
    >>> calibration_key(MethodName.M5, LengthKind.SURFACE_ARC)
    'M5'
    >>> calibration_key(MethodName.M6, LengthDefinition.THREAD)
    'M6 thread'
    >>> calibration_key(MethodName.M6, LengthDefinition.CENTRELINE)
    'M6'
    """
    is_further = method == MethodName.M6 and kind in (
        LengthDefinition.THREAD,
        LengthDefinition.CHORD,
    )
    return f"{method} {kind}" if is_further else str(method)
