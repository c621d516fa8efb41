"""A site's calibration from a run and hand-measured fruit, or from a bar of known length."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision._version import __version__
from cucumbervision.accuracy.measured import REPORTED
from cucumbervision.accuracy.own_truth import comparable, match_truth
from cucumbervision.accuracy.truth import floor_of, read_bar_rows
from cucumbervision.calibration.calibration_file import (
    CalibratedCamera,
    CorrectionEntry,
    DepthScaleEntry,
    IntervalEntry,
    MeasuredWith,
    SiteCalibration,
    TruthUsed,
)
from cucumbervision.calibration.corrections import (
    LEAST_CAPTURES,
    LEVEL,
    Fit,
    fit_correction,
    fit_depth_scale,
)
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.files import parse_model
from cucumbervision.errors import CalibrationError, refusing
from cucumbervision.measurement.result import LengthDefinition

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from cucumbervision.accuracy.measured import Measured, Reading
    from cucumbervision.accuracy.truth import TrueLength, Truth

_BAR_METHODS = ("M6 chord", "M3")
_WORST_SCALE = 0.10
_WORST_SPREAD = 0.02


@dataclass(frozen=True)
class _Run:
    camera: CalibratedCamera
    measured_with: MeasuredWith
    depth_scale: DepthScaleEntry | None


def calibrate_lengths(
    measured: Measured, truth: Truth, name: str, level: float = LEVEL
) -> SiteCalibration:
    """Fit every method's correction to hand-measured fruit.

    Only readings by the method itself count, not those of a method that it fell back on.

    Parameters
    ----------
    measured : Measured
        A run of `measure`, with its JSON.
    truth : Truth
        Hand-measured lengths of its fruit.
    name : str
        What the calibration is called in rows.
    level : float
        Level of the intervals.

    Returns
    -------
    SiteCalibration
        With the depth scale that the run itself was made with, so that one file carries both.

    Raises
    ------
    CalibrationError
        If the camera is not known, or more than one took part.
    TruthError
        If the truth does not fit the run.
    """
    run = _run(measured)
    pairs = match_truth(measured, truth)
    methods = [key for key in pairs[0][1].lengths_m if key != REPORTED]
    entries = [
        entry
        for kind in LengthDefinition
        for method in methods
        if (entry := _entry(method, kind, pairs, level)) is not None
    ]
    if not entries:
        raise CalibrationError(
            "no method measured any of the fruit in the truth",
            source=measured.path,
            remedy="measure with other masks or methods",
        )
    floor = floor_of(truth.lengths)
    used = TruthUsed(
        file=truth.path.name,
        sha256=truth.sha256,
        rows=len(pairs),
        specimens_named=truth.specimens_named,
        floor_mm=floor.sd_mm if floor else None,
        floor_percent=floor.sd_percent if floor else None,
    )
    return _site(name, run, truth=used, corrections=entries)


def calibrate_depth(
    measured: Measured,
    reference_m: float,
    name: str,
    rows: Path | None = None,
    method: str | None = None,
) -> SiteCalibration:
    """Compute the camera's depth scale from captures of a bar of known length.

    Parameters
    ----------
    measured : Measured
        A run of `measure` over captures of the bar.
    reference_m : float
        Its length, metres.
    name : str
        What the calibration is called in rows.
    rows : Path, optional
        A table with columns capture and fruit that says which rows are the bar; without it every
        row is.
    method : str, optional
        Whose length counts; M6's chord where every row has it, else M3.

    Raises
    ------
    CalibrationError
        Below three captures of the bar, if its readings scatter by more than 2 %, or if the scale
        would be more than 10 % off: no depth camera is, so the reference, the intrinsics or the
        mask is wrong.
    """
    run = _run(measured)
    if not 0.05 <= reference_m <= 3:
        raise CalibrationError(
            f"a bar of {reference_m:g} m is none",
            source="--reference-length",
            remedy="give its length in metres, such as 0.500",
        )
    if run.depth_scale is not None:
        raise CalibrationError(
            "was already measured with a depth scale",
            source=measured.path,
            remedy="measure the bar without --calibration",
        )
    bar = _bar_readings(measured, rows)
    method = method or _bar_method(bar, measured)
    lengths = [(reading, reading.lengths_m.get(method)) for reading in bar]
    known = [(reading, x) for reading, x in lengths if x and method not in reading.fell_back]
    if len({reading.capture for reading, _ in known}) < max(LEAST_CAPTURES, len(known)):
        raise CalibrationError(
            f"{method} measured the bar in {len(known)} rows of "
            f"{len({r.capture for r, _ in known})} captures",
            source=measured.path,
            remedy=f"give at least {LEAST_CAPTURES} captures with the bar in each once, or name "
            "its rows in a table with columns capture and fruit",
        )
    pixels = [r.distance_m for r, _ in known if np.isfinite(r.distance_m)]
    pixel_m = float(np.median(pixels)) / run.camera.intrinsics.fx if pixels else 0.0
    found = fit_depth_scale([x for _, x in known], reference_m, pixel_m)
    _require_plausible(found.value, found.spread, known, measured.path)
    entry = DepthScaleEntry(**vars(found), method=method, reference_length_m=reference_m)
    return _site(name, run, depth_scale=entry)


def _site(name: str, run: _Run, **parts: Any) -> SiteCalibration:
    return SiteCalibration(
        name=name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"cucumbervision {__version__}",
        **{**vars(run), **parts},
    )


def _run(measured: Measured) -> _Run:
    if not measured.report:
        raise CalibrationError(
            "does not say which camera took the captures",
            source=measured.path,
            remedy="give the folder of the run, with its measurements.json",
        )
    with refusing(measured.path, CalibrationError, "measure again"):
        return _run_of(measured)


def _run_of(measured: Measured) -> _Run:
    captures = measured.report["captures"]
    cameras = [CalibratedCamera.of(_camera(c, measured), _serial(c)) for c in captures]
    first = next((camera for camera in cameras if camera.serial), cameras[0])
    for capture, camera in zip(captures, cameras, strict=True):
        different = first.difference(camera.intrinsics.intrinsics, camera.serial)
        if different:
            raise CalibrationError(
                f"capture '{capture['name']}' is of another camera than the first: {different}",
                source=measured.path,
                remedy="measure and calibrate each camera on its own",
            )
    report, config = measured.report, measured.report.get("config", {})
    applied = report.get("calibration") or {}
    scale = applied.get("depth_scale")
    measured_with = MeasuredWith(
        software=str(report.get("software", "")),
        config_sha256=str(report.get("config_sha256", "")),
        selector=str(config.get("selector", "")),
        methods=[str(m) for m in config.get("methods", [])],
        instances=str(config.get("instances", "")),
        segmenter=config.get("segmenter"),
        models=list(report.get("models", [])),
        depth_scale=scale["value"] if scale else 1.0,
    )
    depth = DepthScaleEntry.model_validate(scale) if scale else None
    return _Run(first, measured_with, depth)


def _camera(capture: dict[str, Any], measured: Measured) -> Any:
    said = {key.removesuffix("_px"): value for key, value in capture["intrinsics"].items()}
    return parse_model(CameraModel, said, source=measured.path, error=CalibrationError).intrinsics


def _serial(capture: dict[str, Any]) -> str | None:
    serial = (capture.get("provenance") or {}).get("serial")
    return str(serial) if serial else None


def _entry(
    method: str, kind: LengthDefinition, pairs: Sequence[tuple[TrueLength, Reading]], level: float
) -> CorrectionEntry | None:
    known = [
        (one, reading, length)
        for one, reading in pairs
        if one.kind is kind
        and comparable(method, kind, reading.kind)
        and method not in reading.fell_back
        and (length := reading.lengths_m.get(method))
    ]
    if not known:
        return None
    fit = fit_correction(
        [length for _, _, length in known],
        [one.length_m for one, _, _ in known],
        [one.specimen for one, _, _ in known],
        level,
    )
    return CorrectionEntry(
        method=method,
        truth_kind=kind,
        mask_sources=sorted({reading.mask_source for _, reading, _ in known}),
        interval=_interval(fit, level),
        **{name: value for name, value in vars(fit).items() if name != "half_width"},
    )


def _interval(fit: Fit, level: float) -> IntervalEntry:
    width = fit.half_width
    least = int(np.ceil(level / (1 - level) - 1e-9))
    if width is not None:
        reason = f"conformal on {fit.fruit} fruit, each left out of the fit in turn"
    elif fit.fruit < least:
        reason = f"{100 * level:g} % needs {least} fruit, there are {fit.fruit}"
    else:
        reason = "a fruit left out of the fit came out negative"
    return IntervalEntry(level=level, half_width=width, reason=reason)


def _bar_readings(measured: Measured, rows: Path | None) -> list[Reading]:
    if rows is None:
        return list(measured.readings)
    readings = {(r.capture, r.fruit): r for r in measured.readings}
    chosen = []
    for line, capture, fruit in read_bar_rows(rows):
        if (capture, fruit) not in readings:
            raise CalibrationError(
                f"line {line}: fruit {fruit} of capture '{capture}' is not among the measurements",
                source=rows,
                remedy="name rows of the run",
            )
        chosen.append(readings[capture, fruit])
    return chosen


def _bar_method(bar: Sequence[Reading], measured: Measured) -> str:
    for method in _BAR_METHODS:
        if all(reading.lengths_m.get(method) for reading in bar):
            return method
    raise CalibrationError(
        f"neither {' nor '.join(_BAR_METHODS)} measured the bar in every capture",
        source=measured.path,
        remedy="measure with --methods all, or leave out captures where the bar has no mask",
    )


def _require_plausible(
    scale: float, spread: float, known: Sequence[tuple[Reading, float]], path: Path
) -> None:
    middle = float(np.median([x for _, x in known]))
    odd, length = max(known, key=lambda pair: abs(pair[1] - middle))
    if spread > _WORST_SPREAD:
        raise CalibrationError(
            f"the bar's readings scatter by {100 * spread:.1f} %; fruit {odd.fruit} of "
            f"'{odd.capture}' reads {length:.4f} m, the median is {middle:.4f} m",
            source=path,
            remedy="leave that capture out, or name the rows of the bar in a table",
        )
    if abs(scale - 1) > _WORST_SCALE:
        raise CalibrationError(
            f"the bar reads {scale:.3f} times its length, which no depth scale is",
            source=path,
            remedy="check --reference-length (in metres), the intrinsics and the bar's mask",
        )
