"""What a method says of one fruit: a length, or the named reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.measurement.tube_types import TubeFit, TubeLengths
    from cucumbervision.perception.instances import Instance, MaskSource

__all__ = ["Fruit", "Length", "LengthKind", "Measurement", "Method", "Reason"]


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
