"""What a session measured, as records of the store."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision._version import __version__
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.files import json_value
from cucumbervision.capture.frames import Stop
from cucumbervision.geometry.tube import arc_positions
from cucumbervision.measurement.result import Length, Method
from cucumbervision.perception.masks import encode_rle
from cucumbervision.store.images import DEPTH_UNIT_M
from cucumbervision.store.records import (
    ArtifactRecord,
    CaptureRecord,
    DetectionRecord,
    MethodRecord,
    Point,
    StopRecord,
    new_key,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from cucumbervision.calibration.calibration_file import SiteCalibration
    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.result import Fruit, Measurement
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.results import Failure
    from cucumbervision.pipeline.rows import Cell
    from cucumbervision.store.images import ImageStore

__all__ = [
    "MeasuredCapture",
    "artifact_records",
    "capture_record",
    "fruit_record",
    "records_from_result",
    "view_score",
]

PATH_POINTS = 48  # enough to draw a fruit by

_METRES = {
    "length_m": "length_cm",
    "interval_low_m": "interval_low_cm",
    "interval_high_m": "interval_high_cm",
    "centreline_m": "centreline_cm",
    "thread_m": "thread_cm",
    "chord_m": "chord_cm",
    "distance_m": "distance_cm",
    "raw_length_m": "raw_length_cm",
}
_AS_THEY_ARE = (
    *("label", "method", "length_kind", "interval_of", "interval_basis", "tilt_deg"),
    *("hidden_share", "mask_source", "mask_px", "fill", "raw_length_kind"),
)
_BOX = ("box_x1_px", "box_y1_px", "box_x2_px", "box_y2_px")
# A view with one of these shows its fruit less well than one without.
_DOUBTS = frozenset(
    {
        *("cut-by-frame", "box-clipped", "end-hidden", "end-on", "part-hidden", "poor-fit"),
        *("uncertain", "interval-too-wide", "detector-mask"),
    }
)


@dataclass(frozen=True, eq=False)
class MeasuredCapture:
    """One capture of a stop: the frame, its fruit, and their rows in the same order."""

    capture: Capture
    fruit: Sequence[Fruit]
    rows: Sequence[Mapping[str, Cell]]


def records_from_result(
    round_key: str,
    measured: Sequence[MeasuredCapture],
    *,
    key: str | None = None,
    stop: Stop | None = None,
    position_sd_m: float | None = None,
    taken_s: float | None = None,
    images: ImageStore | None = None,
    lossless: bool = True,
    artifacts: Sequence[ArtifactRecord] = (),
    failures: Sequence[Failure] = (),
    length: Length = Length.THREAD,
) -> StopRecord:
    """Make a stop of what was measured there; its pictures are put into `images`.

    Parameters
    ----------
    round_key, measured
        The round's key, and the captures.
    key : str, optional
        The stop's own key, kept for sending it again; a new one by default.
    stop : Stop, optional
        Row, side, position and step; the first capture's by default.
    position_sd_m, taken_s : float, optional
        How sure the position is; when, by default the first capture's time, or now.
    images, lossless, length
        As in `capture_record`.
    artifacts, failures
        What took part (`artifact_records`); what could not be read or measured.
    """
    first = measured[0].capture if measured else None
    place = stop or (first.stop if first else Stop())
    when = first.timestamp_s if first and taken_s is None else taken_s
    return StopRecord(
        key=key or new_key(),
        round_key=round_key,
        row=place.row,
        side=place.side,
        position_m=place.position_m,
        position_sd_m=position_sd_m,
        step=place.step,
        taken_s=time.time() if when is None else when,
        captures=tuple(
            capture_record(m, images, lossless=lossless, length=length) for m in measured
        ),
        artifacts=tuple(artifacts),
        failures=tuple(vars(failure) for failure in failures),
    )


def capture_record(
    measured: MeasuredCapture,
    images: ImageStore | None = None,
    *,
    lossless: bool = True,
    length: Length = Length.THREAD,
) -> CaptureRecord:
    """Make a record of one capture; its pictures are put into `images`.

    Parameters
    ----------
    measured : MeasuredCapture
        The capture.
    images : ImageStore, optional
        None keeps no pictures.
    lossless : bool
        Colour as PNG rather than JPEG.
    length : Length
        The length that the run was asked for.

    Raises
    ------
    StoreError
        If a picture cannot be written.
    """
    capture = measured.capture
    return CaptureRecord(
        name=capture.name,
        frame=capture.frame,
        burst_frame=capture.burst_frame,
        burst_size=capture.burst_size,
        timestamp_s=capture.timestamp_s,
        width_px=capture.width,
        height_px=capture.height,
        fill=round(capture.fill, 4),
        simulated=capture.simulated,
        source=capture.source,
        camera=CameraModel.of(capture.intrinsics).model_dump(mode="json"),
        provenance=json_value(capture.provenance),
        fruit=tuple(
            fruit_record(capture, number, fruit, row, length)
            for number, (fruit, row) in enumerate(
                zip(measured.fruit, measured.rows, strict=True), 1
            )
        ),
        **_pictures(capture, images, lossless=lossless),
    )


def _pictures(capture: Capture, images: ImageStore | None, *, lossless: bool) -> dict[str, Any]:
    if images is None:
        return {}
    return {
        "color": images.put_color(capture.color, lossless=lossless),
        "depth": images.put_depth(capture.depth_m),
        "thumbnail": images.put_thumbnail(capture.color),
        "depth_unit_m": DEPTH_UNIT_M,
    }


def fruit_record(
    capture: Capture,
    number: int,
    fruit: Fruit,
    row: Mapping[str, Cell],
    length: Length = Length.THREAD,
) -> DetectionRecord:
    """Make a record of one fruit from what was measured and its row.

    Lengths are the row's: calibrated where the run was, with its intervals. The fruit's offset
    along the row is how far right of the camera its middle lies; who knows that the row runs
    the other way, or the camera's pose, replaces it.

    Parameters
    ----------
    capture : Capture
        The frame.
    number : int
        The fruit's number in it, from 1.
    fruit : Fruit
        The fruit, measured.
    row : mapping
        As `session.rows.fruit_row` fills it.
    length : Length
        The length that the run was asked for.
    """
    keypoints = fruit.instance.keypoints
    return DetectionRecord(
        number=number,
        score=round(fruit.instance.confidence, 4),
        reason=str(row.get("reason") or ""),
        fallback=str(row.get("fallback") or ""),
        flags=str(row.get("flags") or ""),
        length_sd_m=_length_sd(fruit.selected, length),
        view_score=view_score(fruit, row),
        keypoints=() if keypoints is None else _rows_of(keypoints),
        mask=None if fruit.mask is None else encode_rle(fruit.mask),
        methods=tuple(_method_record(one) for one in fruit.measurements.values()),
        **_cells(capture, fruit, row),
    )


def _cells(capture: Capture, fruit: Fruit, row: Mapping[str, Cell]) -> dict[str, Any]:
    chosen = fruit.selected
    traits = chosen.fit.traits if chosen is not None and chosen.fit is not None else None
    centre = _centre(capture, fruit, row)
    cells: dict[str, Any] = {name: row.get(name) for name in (*_AS_THEY_ARE, *_BOX)}
    for name, column in _METRES.items():
        value = row.get(column)
        cells[name] = round(float(value) / 100, 7) if isinstance(value, int | float) else None
    if traits is not None:
        cells["inner_arc_m"] = round(traits.inner_arc_m, 6)
        cells["diameter_max_m"] = round(traits.diameter_max_m, 6)
        cells["diameter_mean_m"] = round(traits.diameter_mean_m, 6)
        cells["volume_m3"] = round(traits.volume_m3, 9)
    if centre is not None:
        cells["centre_x_m"], cells["centre_y_m"], cells["centre_z_m"] = centre
        cells["offset_m"] = centre[0]
    return cells


def view_score(fruit: Fruit, row: Mapping[str, Cell]) -> float:
    """Say how well a view shows its fruit, 0 to 1; 0 where nothing was measured.

    The detector's confidence times the share of readings in the mask times the share that
    nothing hides; half of that without a fitted tube, and half again for each doubt that the
    flags name. An order among views of one fruit, and no probability.
    """
    if fruit.selected is None:
        return 0.0
    fill, hidden = row.get("fill"), row.get("hidden_share")
    score = fruit.instance.confidence
    score *= float(fill) if isinstance(fill, int | float) else 0.0
    score *= 1.0 - (float(hidden) if isinstance(hidden, int | float) else 0.0)
    halved = len(_DOUBTS & set(str(row.get("flags") or "").split()))
    halved += fruit.selected.tube is None
    return round(score * 0.5**halved, 6)


def artifact_records(
    options: MeasureOptions,
    models: Sequence[Mapping[str, Any]],
    calibration: SiteCalibration | None = None,
) -> tuple[ArtifactRecord, ...]:
    """Name software, configuration, networks and calibration of a run.

    Parameters
    ----------
    options : MeasureOptions
        The run's choices.
    models : sequence of mapping
        `Finder.models`.
    calibration : SiteCalibration, optional
        The one that was applied.
    """
    records = [
        ArtifactRecord("software", f"cucumbervision {__version__}"),
        ArtifactRecord("config", "measure", options.sha256, options.as_json()),
    ]
    for model in models:
        rest = {k: v for k, v in model.items() if k not in {"name", "sha256"}}
        sha256 = str(model.get("sha256") or "")
        records.append(ArtifactRecord("model", str(model["name"]), sha256, json_value(rest)))
    if calibration is not None:
        sha256 = hashlib.sha256(calibration.as_text().encode()).hexdigest()
        details = calibration.model_dump(mode="json")
        records.append(ArtifactRecord("calibration", calibration.name, sha256, details))
    return tuple(records)


def _method_record(measurement: Measurement) -> MethodRecord:
    tube, fit, path = measurement.tube, measurement.fit, measurement.path_m
    diameter: NDArray[np.float64] | None = None
    if fit is not None:
        path = fit.traits.axis_m
        diameter = np.interp(arc_positions(path), fit.traits.along_m, fit.traits.diameter_m)
    kept = np.zeros(0, int)
    if path is not None:
        kept = np.unique(np.linspace(0, len(path) - 1, min(len(path), PATH_POINTS)).round())
        kept = kept.astype(int)
    return MethodRecord(
        method=str(measurement.method),
        length_m=measurement.length_m,
        kind=measurement.kind and str(measurement.kind),
        reason=str(measurement.reason),
        fallback=" > ".join(measurement.fallback),
        measured_by=measurement.measured_by and str(measurement.measured_by),
        centreline_m=None if tube is None else tube.centreline_m,
        thread_m=None if tube is None else tube.thread_m,
        chord_m=None if tube is None else tube.chord_m,
        centreline_sd_m=None if fit is None else fit.centreline_sd_m,
        thread_sd_m=None if fit is None else fit.thread_sd_m,
        path_m=() if path is None else _rows_of(np.round(path[kept], 6)),
        diameter_m=() if diameter is None else tuple(np.round(diameter[kept], 6).tolist()),
    )


def _length_sd(chosen: Measurement | None, length: Length) -> float | None:
    if chosen is None or chosen.fit is None or chosen.method is not Method.M6:
        return None
    fit = chosen.fit
    return fit.thread_sd_m if length is Length.THREAD else fit.centreline_sd_m


def _centre(capture: Capture, fruit: Fruit, row: Mapping[str, Cell]) -> Point | None:
    path = None if fruit.selected is None else fruit.selected.path_m
    if path is not None and len(path):
        return tuple(np.round(path.mean(axis=0), 5).tolist())
    distance = row.get("distance_cm")
    if not isinstance(distance, int | float):
        return None
    left, top, right, bottom = fruit.instance.box
    x, y = capture.intrinsics.rays((left + right) / 2, (top + bottom) / 2)
    z = float(distance) / 100
    return round(float(x) * z, 5), round(float(y) * z, 5), round(z, 5)


def _rows_of(values: NDArray[np.float64]) -> tuple[Point, ...]:
    return tuple(tuple(line) for line in values.tolist())
