"""Calibration files of a site, and their application to a capture's depth and a fruit's length."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field

from cucumbervision.about import code_sha256
from cucumbervision.arrays import Array
from cucumbervision.capture.camera_file import CameraModel, StrictModel
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision.errors import CalibrationError, wrap_os_errors
from cucumbervision.files import parse_model, read_json, replacing
from cucumbervision.methods.flags import LOWER_BOUND, NO_DEPTH, Flag
from cucumbervision.methods.result import (
    Fruit,
    IntervalBasis,
    Length,
    LengthDefinition,
    calibration_key,
)
from cucumbervision.names import checked_name

_FORMAT = "cucumbervision-calibration"
_CAMERA_TOLERANCE_PX = 0.01


class _Frozen(StrictModel):
    model_config = ConfigDict(frozen=True)


class Form(StrEnum):
    """Form of a correction: none, scale, or scale and offset."""

    NONE = "none"
    SCALE = "scale"
    SCALE_OFFSET = "scale+offset"


def corrected(raw_m: ArrayLike, scale: float, offset_m: float) -> Array:
    """Apply a correction.

    Examples
    --------
    >>> corrected([0.20, 0.30], 1.1, -0.01).round(6).tolist()
    [0.21, 0.32]
    """
    return np.asarray(scale * np.asarray(raw_m, float) + offset_m, float)


class CalibratedCamera(_Frozen):
    """The camera whose measurements were calibrated."""

    serial: str | None = None
    intrinsics: CameraModel

    @classmethod
    def of(cls, intrinsics: Intrinsics, serial: str | None = None) -> CalibratedCamera:
        """Create the description of a camera."""
        return cls(serial=serial, intrinsics=CameraModel.of(intrinsics))

    def difference(self, intrinsics: Intrinsics, serial: str | None) -> str:
        """Return the difference to another camera as text; empty for the same camera.

        Compares serial numbers if both are known, and intrinsics to 0.01 pixels.

        Examples
        --------
        >>> from cucumbervision.capture.intrinsics import Intrinsics
        >>> camera = CalibratedCamera.of(Intrinsics(848, 480, 616.4, 616.4, 424.0, 240.0), "841")
        >>> camera.difference(Intrinsics(848, 480, 616.4, 616.4, 424.0, 240.0), None)
        ''
        >>> camera.difference(Intrinsics(1280, 720, 924.6, 924.6, 640.0, 360.0), "841")
        'its intrinsics are 848x480 fx 616.400 px, here 1280x720 fx 924.600 px'
        """
        if self.serial and serial and self.serial != serial:
            return f"its camera is {self.serial}, here {serial}"
        calibrated = self.intrinsics.intrinsics
        same = calibrated.size == intrinsics.size and calibrated.distortion is intrinsics.distortion
        pairs = zip(_numbers(calibrated), _numbers(intrinsics), strict=True)
        if same and all(abs(a - b) <= _CAMERA_TOLERANCE_PX for a, b in pairs):
            return ""
        return f"its intrinsics are {_words(calibrated)}, here {_words(intrinsics)}"


def _numbers(camera: Intrinsics) -> tuple[float, ...]:
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.coefficients


def _words(camera: Intrinsics) -> str:
    return f"{camera.width}x{camera.height} fx {camera.fx_px:.3f} px"


class IntervalEntry(_Frozen):
    """Relative half width of the interval, length (1 -+ half_width), or why there is none."""

    level: float = Field(gt=0, lt=1)
    half_width: float | None = Field(default=None, ge=0)
    reason: str


class CorrectionEntry(_Frozen):
    """Correction of one method for one definition of length: scale x reading + offset.

    Errors are mean absolute relative errors with the same weight for every fruit; after the
    correction, each fruit is left out of the fit in turn. Outside `raw_range_m` the correction is
    an extrapolation.
    """

    method: str
    truth_kind: LengthDefinition
    form: Form
    scale: float = Field(gt=0, lt=1000)
    offset_m: float = Field(gt=-1000, lt=1000)
    reason: str
    fruit: int
    captures: int
    error_before_percent: float
    error_after_percent: float
    residual_sd_percent: float
    raw_range_m: tuple[float, float]
    mask_sources: list[str]
    interval: IntervalEntry


class DepthScaleEntry(_Frozen):
    """Ratio of measured to true depth, from pictures of a printed grid."""

    value: float = Field(gt=0.5, lt=2)
    standard_error: float = Field(ge=0)
    spread: float
    captures: int
    spacing_m: float = Field(gt=0)


class LensEntry(_Frozen):
    """Lens distortion from the same grid, Brown-Conrady k1, k2, p1, p2, k3, and the residual."""

    coefficients: tuple[float, float, float, float, float]
    residual_px: float = Field(ge=0)


class SiteCalibration(_Frozen):
    """Contents of a calibration file.

    `measured_with` describes the run that was calibrated, `truth` the table of manual lengths.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = CalibratedCamera.of(Intrinsics(848, 480, 616.4, 616.4, 424.0, 240.0))
    >>> site = SiteCalibration(name="house-3", created="2026-05-02T10:00:00+00:00", software="x",
    ...     camera=camera)
    >>> site.depth_divisor, site.entry("M5", LengthDefinition.THREAD) is None
    (1.0, True)
    """

    format: Literal["cucumbervision-calibration"] = "cucumbervision-calibration"
    version: Literal[1] = 1
    name: str = Field(min_length=1, max_length=60)
    created: str
    software: str
    camera: CalibratedCamera
    measured_with: dict[str, Any] | None = None
    truth: dict[str, Any] | None = None
    depth_scale: DepthScaleEntry | None = None
    lens: LensEntry | None = None
    corrections: list[CorrectionEntry] = Field(default_factory=list)
    interval_basis: Literal["own truth"] = "own truth"

    @property
    def depth_divisor(self) -> float:
        """Divisor applied to depth before measuring."""
        return self.depth_scale.value if self.depth_scale else 1.0

    @property
    def is_of_other_version(self) -> bool:
        """Whether its corrections are of lengths that another version of this package measured."""
        measured_by = (self.measured_with or {}).get("code_sha256")
        return bool(self.corrections) and measured_by != code_sha256()

    @property
    def sha256(self) -> str:
        """SHA-256 of the content, hexadecimal."""
        return hashlib.sha256(self.as_text().encode()).hexdigest()

    @property
    def tag(self) -> str:
        """Name and the first eight digits of `sha256`, for result rows."""
        return f"{self.name}@{self.sha256[:8]}"

    def entry(self, method: str, kind: LengthDefinition) -> CorrectionEntry | None:
        """Return the correction of a method for a definition of length, or None.

        Parameters
        ----------
        method : str
            'M1' … 'M5', 'M6' (centreline), 'M6 thread', 'M6 chord'.
        kind : LengthDefinition
            Definition of length.
        """
        entries = (e for e in self.corrections if e.method == method and e.truth_kind is kind)
        return next(entries, None)

    def as_text(self) -> str:
        """Return the contents of the file."""
        return json.dumps(self.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n"


def read_site_calibration(path: Path) -> SiteCalibration:
    """Read a calibration file.

    Raises
    ------
    CalibrationError
        If the file is missing, is not a calibration file, or has another version.
    NameRefusedError
        If its name cannot be read.
    """
    remedy = "make it with `cucumbervision calibrate`"
    data = read_json(path, CalibrationError, remedy)
    if not isinstance(data, dict) or data.get("format") != _FORMAT:
        raise CalibrationError("is not a calibration file", source=path, remedy=remedy)
    if data.get("version") != 1:
        raise CalibrationError(
            f"is of version {data.get('version')}, this software reads version 1",
            source=path,
            remedy="calibrate again with this software",
        )
    site = parse_model(SiteCalibration, data, source=path, error=CalibrationError)
    checked_name(site.name, "calibration's name")
    return site


def write_site_calibration(path: Path, site: SiteCalibration) -> None:
    """Write a calibration file.

    Raises
    ------
    CalibrationError
        If the file cannot be written.
    """
    with wrap_os_errors("cannot be written", path, kind=CalibrationError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            part.write_text(site.as_text(), encoding="utf-8")


_RANGE_MARGIN = 0.10


def calibrated_capture(capture: Capture, site: SiteCalibration) -> Capture:
    """Return a capture with its depth divided by the calibrated depth scale, and its lens.

    Every length scales by 1 / scale: x = z (u - cx)/fx and y scale with the depth z as z itself
    does. A depth gate in metres, such as M2's, keeps its width. The calibrated distortion takes
    the place of the capture's own.

    Parameters
    ----------
    capture : Capture
        The frame, before calibration.
    site : SiteCalibration
        The calibration.

    Raises
    ------
    CalibrationError
        If the calibration was made for another camera.
    """
    serial = capture.provenance.get("serial")
    different = site.camera.difference(capture.intrinsics, str(serial) if serial else None)
    if different:
        raise CalibrationError(
            "calibration '{name}' was made for another camera: {different}",
            source=capture.source or capture.name,
            remedy="calibrate this camera, or measure it without --calibration",
            name=site.name,
            different=different,
        )
    if site.depth_scale is None:
        return capture
    intrinsics = capture.intrinsics
    if site.lens is not None:
        kind, numbers = Distortion.BROWN_CONRADY, site.lens.coefficients
        intrinsics = replace(intrinsics, distortion=kind, coefficients=numbers)
    depth_m = capture.depth_m / np.float32(site.depth_divisor)
    return replace(capture, depth_m=depth_m, intrinsics=intrinsics)


_UNLIKE = LOWER_BOUND | NO_DEPTH | {Flag.UPPER_END, Flag.LOWER_END, Flag.LEFT_END, Flag.RIGHT_END}
"""Flags of fruit unlike those from which a calibration's interval was learnt."""


def _is_alike(fruit: Fruit) -> bool:
    """Return whether a fruit is like those that were measured by hand: whole, and well seen."""
    too_wide = fruit.fit is not None and Flag.INTERVAL_TOO_WIDE in fruit.flags
    return _UNLIKE.isdisjoint(fruit.flags) and not too_wide


def _corrected_length(raw: Length, entry: CorrectionEntry, *, keep: bool) -> Length:
    """Return a corrected length, and with `keep` its interval, corrected in the same way."""
    if entry.form is Form.NONE:
        return raw
    value_m, kind = float(corrected(raw.value_m, entry.scale, entry.offset_m)), entry.truth_kind
    if not keep or raw.low_m is None or raw.high_m is None or raw.interval_of is not kind:
        return Length(value_m, kind)
    low_m, high_m = corrected([raw.low_m, raw.high_m], entry.scale, entry.offset_m).tolist()
    return Length(value_m, kind, low_m, high_m, kind, raw.basis)


def calibrated_fruit(
    fruit: Fruit, site: SiteCalibration, definition: LengthDefinition = LengthDefinition.CENTRELINE
) -> Fruit:
    """Return a fruit with a corrected length; the measurements of the methods are unchanged.

    Parameters
    ----------
    fruit : Fruit
        As `measure_fruit` returns it.
    site : SiteCalibration
        The calibration.
    definition : LengthDefinition
        The length that is wanted: the kind of truth whose correction applies.

    Returns
    -------
    Fruit
        The fruit with `calibration`, the uncorrected `raw_length`, the corrected `length` and, if
        the calibration has one, its interval. A fruit that may go on out of sight, or whose depth
        cannot be its distance, keeps its interval from simulated fruit, corrected. If the
        calibration was made with another version of this package, or does not apply to the method,
        mask or length, only a flag is added.
    """
    if site.depth_scale is not None:
        fruit = replace(fruit, calibration=site.tag)
    raw, method = fruit.length, fruit.method
    if raw is None or method is None or not site.corrections:
        return fruit
    if site.is_of_other_version:
        return fruit.flagged(Flag.OTHER_VERSION)
    entry = site.entry(calibration_key(method, raw.kind), definition)
    if entry is None:
        return fruit.flagged(Flag.NOT_COVERED)
    if (fruit.mask_source or "") not in entry.mask_sources:
        return fruit.flagged(Flag.OTHER_MASK)
    # The interval of a whole fruit belongs to the uncorrected length. That of one which may go on
    # out of sight holds what is missing, of which fruit measured by hand say nothing.
    is_alike = _is_alike(fruit)
    length = _corrected_length(raw, entry, keep=not is_alike)
    if length.value_m <= 0:
        return fruit.flagged(Flag.OUTSIDE_RANGE)
    done = replace(fruit, calibration=site.tag, raw_length=raw, length=length)
    low_m, high_m = entry.raw_range_m
    if not (1 - _RANGE_MARGIN) * low_m <= raw.value_m <= (1 + _RANGE_MARGIN) * high_m:
        return done.flagged(Flag.OUTSIDE_RANGE)
    half = entry.interval.half_width
    if half is None or not is_alike:
        return done
    kind, value_m = entry.truth_kind, length.value_m
    limits = value_m * (1 - half), value_m * (1 + half)
    length = Length(value_m, kind, *limits, kind, IntervalBasis.OWN_TRUTH)
    return replace(done, length=length).unflagged(Flag.INTERVAL_TOO_WIDE)
