"""Calibrate a site from a run with manual lengths, or from pictures of a printed grid."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision._version import __version__
from cucumbervision.accuracy.measured import REPORTED
from cucumbervision.accuracy.own_truth import comparable, match_truth
from cucumbervision.accuracy.truth import floor_of
from cucumbervision.calibration.calibration_file import (
    CalibratedCamera,
    CorrectionEntry,
    DepthScaleEntry,
    IntervalEntry,
    LensEntry,
    MeasuredWith,
    SiteCalibration,
    TruthUsed,
)
from cucumbervision.calibration.corrections import LEVEL, Fit, fit_correction
from cucumbervision.calibration.grid import LEAST_CROSSINGS, fit_grid
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.errors import CalibrationError, wrap_reader_errors
from cucumbervision.files import parse_model
from cucumbervision.measurement.result import LengthDefinition

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cucumbervision.accuracy.measured import Measured, Reading
    from cucumbervision.accuracy.truth import TrueLength, Truth
    from cucumbervision.capture.frames import Capture

_WORST_SCALE = 0.10
_PLANE_ERROR = 0.002  # systematic relative error of a plane's depth


@dataclass(frozen=True)
class _Run:
    camera: CalibratedCamera
    measured_with: MeasuredWith | None
    depth_scale: DepthScaleEntry | None
    lens: LensEntry | None


def calibrate_lengths(measured: Measured, truth: Truth, name: str) -> SiteCalibration:
    """Fit the correction of every method to manual lengths.

    Only readings of the method itself are used, not fallbacks to another method.

    Parameters
    ----------
    measured : Measured
        A run of `measure` with its JSON file.
    truth : Truth
        Manual lengths of its fruit.
    name : str
        Name of the calibration in result rows.

    Returns
    -------
    SiteCalibration
        Calibration that includes the depth scale and lens distortion used in the run.

    Raises
    ------
    CalibrationError
        If the camera is unknown, or several cameras were used.
    TruthError
        If the manual lengths do not match the run.
    """
    run = _run(measured)
    pairs = match_truth(measured, truth)
    methods = [key for key in pairs[0][1].lengths_m if key != REPORTED]
    entries = [
        entry
        for kind in LengthDefinition
        for method in methods
        if (entry := _entry(method, kind, pairs)) is not None
    ]
    if not entries:
        raise CalibrationError(
            "no method measured any of the fruit in the truth whole",
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


def calibrate_camera(captures: Iterable[Capture], spacing_m: float, name: str) -> SiteCalibration:
    """Calibrate depth scale and lens distortion of a camera from pictures of a printed grid.

    Parameters
    ----------
    captures : iterable of Capture
        Captures of one camera; captures without a grid are skipped.
    spacing_m : float
        Distance between the grid lines, metres.
    name : str
        Name of the calibration in result rows.

    Raises
    ------
    CalibrationError
        If several cameras were used, no grid is found, or the depth scale deviates by more than
        10 %, which indicates a wrong spacing or wrong intrinsics.
    """
    taken = list(captures)
    cameras = [
        CalibratedCamera.of(capture.intrinsics, _serial({"provenance": capture.provenance}))
        for capture in taken
    ]
    for capture, camera in zip(taken, cameras, strict=True):
        different = cameras[0].difference(camera.intrinsics.intrinsics, camera.serial)
        if different:
            raise _other_camera(capture.name, different, capture.source)
    fit = fit_grid(taken, spacing_m)
    if fit is None:
        raise CalibrationError(
            "no grid of {crossings} crossings in {captures} captures",
            source="calibrate --grid",
            remedy="show a flat square grid whose lines are 12 to 60 pixels apart",
            crossings=LEAST_CROSSINGS,
            captures=len(taken),
        )
    scale, count = float(np.mean(fit.ratios)), len(fit.ratios)
    if abs(scale - 1) > _WORST_SCALE:
        raise CalibrationError(
            "depth reads {scale:.3f} times the distance of the grid, which no depth scale is",
            source="calibrate --grid",
            remedy="check the spacing of the lines (in millimetres) and the intrinsics",
            scale=scale,
        )
    spread = float(fit.ratios.std(ddof=1)) if count > 1 else 0.0
    entry = DepthScaleEntry(
        value=scale,
        standard_error=float(np.hypot(spread / np.sqrt(count), _PLANE_ERROR)),
        spread=spread,
        captures=count,
        spacing_m=spacing_m,
    )
    k1, k2, p1, p2, k3 = fit.coefficients.tolist()
    lens = LensEntry(coefficients=(k1, k2, p1, p2, k3), residual_px=fit.residual_px)
    run = _Run(cameras[0], None, entry, lens)
    return _site(name, run)


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
    with wrap_reader_errors(measured.path, CalibrationError, "measure again"):
        return _run_of(measured)


def _run_of(measured: Measured) -> _Run:
    captures = measured.report["captures"]
    applied = measured.report.get("calibration") or {}
    cameras = [CalibratedCamera.of(_camera(c, measured), _serial(c)) for c in captures]
    first = next((camera for camera in cameras if camera.serial), cameras[0])
    for capture, camera in zip(captures, cameras, strict=True):
        different = first.difference(camera.intrinsics.intrinsics, camera.serial)
        if different:
            raise _other_camera(capture["name"], different, str(measured.path))
    report, config = measured.report, measured.report.get("config", {})
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
    lens = applied.get("lens")
    if lens is None:
        return _Run(first, measured_with, depth, None)
    # Captures of the run have the calibrated lens; the calibration describes the camera without it.
    bare = CalibratedCamera.model_validate(applied["camera"])
    return _Run(bare, measured_with, depth, LensEntry.model_validate(lens))


def _other_camera(capture: str, different: str, source: str) -> CalibrationError:
    return CalibrationError(
        "capture '{name}' is of another camera than the first: {different}",
        source=source,
        remedy="calibrate each camera on its own",
        name=capture,
        different=different,
    )


def _camera(capture: dict[str, Any], measured: Measured) -> Any:
    camera = {key.removesuffix("_px"): value for key, value in capture["intrinsics"].items()}
    return parse_model(CameraModel, camera, source=measured.path, error=CalibrationError).intrinsics


def _serial(capture: Mapping[str, Any]) -> str | None:
    serial = (capture.get("provenance") or {}).get("serial")
    return str(serial) if serial else None


def _entry(
    method: str, kind: LengthDefinition, pairs: Sequence[tuple[TrueLength, Reading]]
) -> CorrectionEntry | None:
    usable = [
        (length_by_hand, reading, length)
        for length_by_hand, reading in pairs
        if length_by_hand.kind is kind
        and comparable(method, kind, reading.kind)
        and method not in reading.fell_back
        and reading.is_whole
        and (length := reading.lengths_m.get(method))
    ]
    if not usable:
        return None
    fit = fit_correction(
        [length for _, _, length in usable],
        [length_by_hand.length_m for length_by_hand, _, _ in usable],
        [length_by_hand.specimen for length_by_hand, _, _ in usable],
    )
    return CorrectionEntry(
        method=method,
        truth_kind=kind,
        mask_sources=sorted({reading.mask_source for _, reading, _ in usable}),
        interval=_interval(fit),
        **{name: value for name, value in vars(fit).items() if name != "half_width"},
    )


def _interval(fit: Fit) -> IntervalEntry:
    width = fit.half_width if fit.half_width is not None and fit.half_width < 1 else None
    least_fruit = int(np.ceil(LEVEL / (1 - LEVEL) - 1e-9))
    if width is not None:
        reason = f"conformal on {fit.fruit} fruit, each left out of the fit in turn"
    elif fit.fruit < least_fruit:
        reason = f"{100 * LEVEL:g} % needs {least_fruit} fruit, there are {fit.fruit}"
    else:
        reason = "a fruit left out of the fit is off by more than its length"
    return IntervalEntry(level=LEVEL, half_width=width, reason=reason)
