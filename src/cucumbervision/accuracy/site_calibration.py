"""Calibrate a site: fit corrections to manual lengths, or depth and lens to a printed grid."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cucumbervision._version import __version__
from cucumbervision.accuracy.calibration_file import (
    CalibratedCamera,
    CorrectionEntry,
    Form,
    IntervalEntry,
    SiteCalibration,
    corrected,
)
from cucumbervision.accuracy.grid import LEAST_CROSSINGS, fit_grid
from cucumbervision.accuracy.own_truth import REPORTED, Measured, Reading, comparable, match_truth
from cucumbervision.accuracy.truth import TrueLength, Truth, floor_of
from cucumbervision.arrays import Array, Ints
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Capture
from cucumbervision.errors import CalibrationError, wrap_reader_errors
from cucumbervision.files import parse_model
from cucumbervision.methods.result import LengthDefinition

_WORST_SCALE = 0.10
_PLANE_ERROR = 0.002  # systematic relative error of a plane's depth


def calibrate_lengths(measured: Measured, truth: Truth, name: str) -> SiteCalibration:
    """Fit the correction of every method to manual lengths.

    Only readings of the method itself are used, not fallbacks to another method.

    Parameters
    ----------
    measured : Measured
        A run of `measure`.
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
        If several cameras were used.
    TruthError
        If the manual lengths do not match the run.
    """
    with wrap_reader_errors(measured.path, CalibrationError, "measure again"):
        run = _run_of(measured)
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
    used = {
        "file": truth.path.name,
        "sha256": truth.sha256,
        "rows": len(pairs),
        "specimens_named": truth.specimens_named,
        "floor_mm": floor and floor.sd_mm,
        "floor_percent": floor and floor.sd_percent,
    }
    return _site(name, truth=used, corrections=entries, **run)


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
    depth_scale = {
        "value": scale,
        "standard_error": float(np.hypot(spread / np.sqrt(count), _PLANE_ERROR)),
        "spread": spread,
        "captures": count,
        "spacing_m": spacing_m,
    }
    lens = {"coefficients": fit.coefficients.tolist(), "residual_px": fit.residual_px}
    return _site(name, camera=cameras[0], depth_scale=depth_scale, lens=lens)


def _site(name: str, **parts: Any) -> SiteCalibration:
    return SiteCalibration(
        name=name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"cucumbervision {__version__}",
        **parts,
    )


def _run_of(measured: Measured) -> dict[str, Any]:
    """Return the camera of a run, what was measured with, and the calibration that it used."""
    report = measured.report
    captures, applied = report["captures"], report.get("calibration") or {}
    cameras = [CalibratedCamera.of(_camera(c, measured), _serial(c)) for c in captures]
    first = next((camera for camera in cameras if camera.serial), cameras[0])
    for capture, camera in zip(captures, cameras, strict=True):
        different = first.difference(camera.intrinsics.intrinsics, camera.serial)
        if different:
            raise _other_camera(capture["name"], different, str(measured.path))
    config, scale, lens = report.get("config", {}), applied.get("depth_scale"), applied.get("lens")
    measured_with = {
        "software": str(report.get("software", "")),
        **{key: str(report.get(key, "")) for key in ("config_sha256", "code_sha256")},
        **{key: str(config.get(key, "")) for key in ("selector", "instances")},
        "methods": list(map(str, config.get("methods", []))),
        "segmenter": config.get("segmenter"),
        "models": list(report.get("models", [])),
        "depth_scale": scale["value"] if scale else 1.0,
    }
    # Captures of the run have the calibrated lens; the calibration describes the camera without it.
    camera = applied["camera"] if lens else first
    return {"camera": camera, "measured_with": measured_with, "depth_scale": scale, "lens": lens}


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
    return fit_correction(
        [length for _, _, length in usable],
        [length_by_hand.length_m for length_by_hand, _, _ in usable],
        [length_by_hand.specimen for length_by_hand, _, _ in usable],
        method=method,
        truth_kind=kind,
        mask_sources=sorted({reading.mask_source for _, reading, _ in usable}),
    )


def _interval(width: float | None, fruit: int) -> IntervalEntry:
    least_fruit = int(np.ceil(LEVEL / (1 - LEVEL) - 1e-9))
    if width is not None and width < 1:
        reason = f"conformal on {fruit} fruit, each left out of the fit in turn"
        return IntervalEntry(level=LEVEL, half_width=width, reason=reason)
    reason = "a fruit left out of the fit is off by more than its length"
    if fruit < least_fruit:
        reason = f"{100 * LEVEL:g} % needs {least_fruit} fruit, there are {fruit}"
    return IntervalEntry(level=LEVEL, reason=reason)


LEVEL = 0.90

_HUBER = 1.345

_LEAST_GAIN_POINTS = 0.01

_MOST_ITERATIONS = 50

_TOLERANCE = 1e-9


_MIN_FRUIT = {Form.SCALE: 6, Form.SCALE_OFFSET: 10}


def fit_correction(
    raw_m: ArrayLike,
    truth_m: ArrayLike,
    fruit: Sequence[Hashable],
    *,
    method: str = "",
    truth_kind: LengthDefinition = LengthDefinition.CENTRELINE,
    mask_sources: Sequence[str] = (),
) -> CorrectionEntry:
    """Choose and fit a correction by leave-one-fruit-out cross-validation.

    Relative errors are fitted by Huber's estimator with the same weight for every fruit. A form
    with more parameters is chosen only if there are enough fruit (`_MIN_FRUIT`) and it reduces the
    cross-validated error by more than the standard error of the gain.

    Parameters
    ----------
    raw_m, truth_m : array_like of float, shape (N,)
        Readings and true lengths, metres, all positive and finite.
    fruit : sequence of hashable, length N
        Physical fruit of each reading; all readings of a fruit are left out together.
    method, truth_kind, mask_sources
        As in `CorrectionEntry`.

    Returns
    -------
    CorrectionEntry
        The chosen correction.

    Raises
    ------
    ValueError
        If there are no readings, or a length is not positive.

    Examples
    --------
    >>> truth = np.array([0.12, 0.15, 0.18, 0.21, 0.25, 0.30])
    >>> fit = fit_correction(truth / 1.05, truth, list("abcdef"))
    >>> str(fit.form), round(fit.scale, 4), round(fit.error_before_percent, 2)
    ('scale', 1.05, 4.76)
    """
    raw, truth = np.asarray(raw_m, float), np.asarray(truth_m, float)
    if not raw.size or not ((raw > 0) & (truth > 0)).all():
        raise ValueError("readings and true lengths must be positive, and at least one")
    names, member = np.unique([str(name) for name in fruit], return_inverse=True)
    held_out = {Form.NONE: raw}
    chosen, reasons = Form.NONE, []
    for form, least_fruit in _MIN_FRUIT.items():
        if len(names) < least_fruit:
            reasons.append(f"{form} needs {least_fruit} fruit, there are {len(names)}")
            continue
        held_out[form] = _leave_one_out(form, raw, truth, member)
        gain, error = _gain(held_out[chosen], held_out[form], truth, member)
        verdict = f"{form} gains {gain:.2f} points, standard error {error:.2f}"
        if gain > max(error, _LEAST_GAIN_POINTS):
            chosen, reasons = form, [verdict]
        else:
            reasons.append(f"{verdict}: no help")
    scale, offset = _fit(chosen, raw, truth, _weights(member))
    if scale <= 0:
        reasons.append("it reads shorter, the longer the fruit is: no correction")
        chosen, scale, offset = Form.NONE, 1.0, 0.0
    predicted = held_out[chosen]
    relative, weights = predicted / truth - 1, _weights(member) / len(names)
    centred = relative - float(weights @ relative)
    # Scores are relative to the corrected length, because only that is known at run time.
    scores = np.where(predicted > 0, np.abs(truth / np.maximum(predicted, 1e-12) - 1), np.inf)
    return CorrectionEntry(
        method=method,
        truth_kind=truth_kind,
        form=chosen,
        scale=scale,
        offset_m=offset,
        reason="; ".join(reasons),
        fruit=len(names),
        captures=raw.size,
        error_before_percent=100 * float(weights @ np.abs(raw / truth - 1)),
        error_after_percent=100 * float(weights @ np.abs(relative)),
        residual_sd_percent=100 * float(np.sqrt(weights @ centred**2)),
        raw_range_m=(float(raw.min()), float(raw.max())),
        mask_sources=list(mask_sources),
        interval=_interval(conformal_half_width(scores, member), len(names)),
    )


def conformal_half_width(
    scores: ArrayLike, fruit: Sequence[Hashable] | NDArray[np.int64]
) -> float | None:
    """Return the score that a reading of a new fruit does not exceed with probability `LEVEL`.

    Hierarchical conformal prediction (Lee, Barber and Willett, 2023): each of K fruit has the
    weight 1/(K + 1), shared by its readings, and the new fruit has 1/(K + 1) at infinity, because
    captures of one fruit are not independent. With one reading per fruit, this is the k-th smallest
    score, k = ceil(LEVEL (K + 1)).

    Parameters
    ----------
    scores : array_like of float, shape (N,)
        Positive errors of fruit left out of the fit.
    fruit : sequence of hashable, length N
        Physical fruit of each score.

    Returns
    -------
    float or None
        None if K is too small for the level (below 9 fruit at 0.9), or the score is NaN.

    Examples
    --------
    >>> conformal_half_width([1, 2, 3, 4, 5, 6, 7, 8, 9], list("abcdefghi"))
    9.0
    >>> conformal_half_width([1, 2, 3, 4, 5, 6, 7, 8], list("abcdefgh")) is None
    True
    """
    values = np.asarray(scores, float)
    names, member = np.unique([str(name) for name in fruit], return_inverse=True)
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(_weights(member)[order]) >= LEVEL * (len(names) + 1) - 1e-9
    if not reached.any():
        return None
    width = float(values[order][int(np.argmax(reached))])
    return width if np.isfinite(width) else None


def _weights(member: Ints) -> Array:
    return np.asarray(1.0 / np.bincount(member)[member])


def _fit(form: Form, raw: Array, truth: Array, weights: Array) -> tuple[float, float]:
    if form is Form.NONE:
        return 1.0, 0.0
    columns = [raw / truth] if form is Form.SCALE else [raw / truth, 1 / truth]
    design = np.stack(columns, axis=1)
    trust = np.ones_like(raw)
    solution: Array = np.zeros(len(columns))
    for _ in range(_MOST_ITERATIONS):
        root = np.sqrt(weights * trust)
        before = solution
        solution = np.asarray(np.linalg.lstsq(design * root[:, None], root, rcond=None)[0], float)
        residual = np.abs(design @ solution - 1)
        # The floor avoids dividing by rounding errors if readings have no noise.
        bound = _HUBER * max(1.4826 * float(np.median(residual)), 1e-9)
        trust = np.minimum(1.0, bound / np.maximum(residual, 1e-12))
        if np.abs(solution - before).max() < _TOLERANCE:
            break
    return float(solution[0]), float(solution[1]) if form is Form.SCALE_OFFSET else 0.0


def _leave_one_out(form: Form, raw: Array, truth: Array, member: Ints) -> Array:
    weights, predicted = _weights(member), np.empty_like(raw)
    for k in range(int(member.max()) + 1):
        out = member == k
        predicted[out] = corrected(raw[out], *_fit(form, raw[~out], truth[~out], weights[~out]))
    return predicted


def _gain(simpler_m: Array, richer_m: Array, truth_m: Array, member: Ints) -> tuple[float, float]:
    worse = np.abs(simpler_m / truth_m - 1) - np.abs(richer_m / truth_m - 1)
    gains = 100 * np.bincount(member, worse) / np.bincount(member)
    return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains)))
