"""Apply a site's calibration: to the depth before measuring, to each row after it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.calibration.calibration_file import OWN_TRUTH
from cucumbervision.calibration.corrections import Form, corrected
from cucumbervision.errors import CalibrationError
from cucumbervision.measurement.result import Length, Method

if TYPE_CHECKING:
    from cucumbervision.calibration.calibration_file import CorrectionEntry, SiteCalibration
    from cucumbervision.capture.frames import Capture
    from cucumbervision.pipeline.rows import Cell

__all__ = ["CalibrationFlag", "calibrated_capture", "calibrated_row"]

RANGE_MARGIN = 0.10
INTERVAL_COLUMNS = ("interval_low_cm", "interval_high_cm", "interval_of", "interval_basis")
TUBE_KEYS = {
    str(Length.CENTRELINE): "M6",
    str(Length.THREAD): "M6 thread",
    str(Length.CHORD): "M6 chord",
}


class CalibrationFlag:
    """Why a row was not corrected, or should be read with care; stable codes for tables."""

    NOT_COVERED = "calibration-not-covered"
    OTHER_MASK = "calibration-other-mask"
    OUTSIDE_RANGE = "outside-calibrated-range"


def calibrated_capture(capture: Capture, site: SiteCalibration) -> Capture:
    """Divide a capture's depth by the calibrated depth scale.

    Every length scales by 1 / scale: x = z (u - cx)/fx and y scale with the depth z as z itself
    does. A depth gate in metres, such as M2's, keeps its width.

    Parameters
    ----------
    capture : Capture
        The frame as it was read.
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
            f"calibration '{site.name}' was made for another camera: {different}",
            source=capture.source or capture.name,
            remedy="calibrate this camera, or measure it without --calibration",
        )
    if site.depth_scale is None:
        return capture
    return replace(capture, depth_m=capture.depth_m / np.float32(site.depth_divisor))


def calibrated_row(
    row: dict[str, Cell], site: SiteCalibration, length: Length = Length.THREAD
) -> dict[str, Cell]:
    """Correct a row's `length_cm`; the columns of the single methods stay as they were read.

    Parameters
    ----------
    row : dict
        As `session.rows.fruit_row` fills it.
    site : SiteCalibration
        The calibration.
    length : Length
        The length that is wanted: the kind of truth whose correction applies.

    Returns
    -------
    dict
        A row that names the calibration, with `raw_length_cm` as read, the corrected `length_cm`
        and, where the calibration carries one, the interval. Where it does not cover the row's
        method, mask or length, the row is unchanged but for a flag.
    """
    done = dict(row)
    if site.depth_scale is not None:
        done.update(calibration=site.tag)
    raw_cm = row["length_cm"]
    if not isinstance(raw_cm, int | float):
        return done
    entry = site.entry(_key(row), length)
    fault = _fault(entry, row, float(raw_cm))
    if entry is None or fault:
        return {**done, "flags": _flagged(row, fault)}
    done.update(calibration=site.tag, raw_length_cm=raw_cm, raw_length_kind=row["length_kind"])
    length_cm = _corrected_cm(entry, float(raw_cm))
    if entry.form is not Form.NONE:
        # An interval from before belongs to the length as it was read.
        done.update(dict.fromkeys(INTERVAL_COLUMNS))
        done.update(length_cm=round(length_cm, 3), length_kind=str(entry.truth_kind))
    low, high = (limit * 100 for limit in entry.raw_range_m)
    if not (1 - RANGE_MARGIN) * low <= raw_cm <= (1 + RANGE_MARGIN) * high:
        return {**done, "flags": _flagged(row, CalibrationFlag.OUTSIDE_RANGE)}
    half = entry.interval.half_width
    if half is not None:
        done.update(
            length_kind=str(entry.truth_kind),
            interval_low_cm=round(length_cm * (1 - half), 3),
            interval_high_cm=round(length_cm * (1 + half), 3),
            interval_of=str(entry.truth_kind),
            interval_basis=OWN_TRUTH,
        )
    return done


def _key(row: dict[str, Cell]) -> str:
    if row["method"] == Method.M6:
        return TUBE_KEYS.get(str(row["length_kind"]), "M6")
    return str(row["method"])


def _fault(entry: CorrectionEntry | None, row: dict[str, Cell], raw_cm: float) -> str:
    if entry is None:
        return CalibrationFlag.NOT_COVERED
    if (row["mask_source"] or "") not in entry.mask_sources:
        return CalibrationFlag.OTHER_MASK
    return "" if _corrected_cm(entry, raw_cm) > 0 else CalibrationFlag.OUTSIDE_RANGE


def _corrected_cm(entry: CorrectionEntry, raw_cm: float) -> float:
    return 100 * float(corrected(raw_cm / 100, entry.scale, entry.offset_m))


def _flagged(row: dict[str, Cell], flag: str) -> str:
    return " ".join(part for part in (str(row["flags"] or ""), flag) if part)
