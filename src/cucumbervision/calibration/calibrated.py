"""Apply a site's calibration to a capture's depth and to a fruit's length."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.calibration.corrections import Form, corrected
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Distortion
from cucumbervision.errors import CalibrationError
from cucumbervision.measurement.flags import DOUBTFUL_END, LOWER_BOUND, NO_DEPTH, Flag
from cucumbervision.measurement.result import (
    Fruit,
    IntervalBasis,
    Length,
    LengthDefinition,
    calibration_key,
)

if TYPE_CHECKING:
    from cucumbervision.calibration.calibration_file import CorrectionEntry, SiteCalibration


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


_UNLIKE = frozenset({*LOWER_BOUND, *NO_DEPTH, *DOUBTFUL_END.values()})
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
        calibration does not apply to the method, mask or length, only a flag is added.
    """
    if site.depth_scale is not None:
        fruit = replace(fruit, calibration=site.tag)
    raw, method = fruit.length, fruit.method
    if raw is None or method is None or not site.corrections:
        return fruit
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
