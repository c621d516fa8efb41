"""Convert measurements to records of the store."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision._version import __version__
from cucumbervision.accuracy.calibration_file import SiteCalibration
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Capture, Doubt, Stop
from cucumbervision.capture.readers.native import MANIFEST
from cucumbervision.capture.source import CaptureRef
from cucumbervision.errors import InstancesError, Message
from cucumbervision.files import json_value
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.mask_codes import decode_rle, encode_rle
from cucumbervision.fruit.masks import box_ious
from cucumbervision.run.batch import LoopOptions, ResultWorker, measure_all
from cucumbervision.run.fields import stored_row
from cucumbervision.run.inputs import Listed
from cucumbervision.run.measurer import Boundary, Failure, Measurer
from cucumbervision.run.options import GRAVITY_BY_EDGE
from cucumbervision.tube.shape import arc_positions
from cucumbervision_greenhouse.rounds.poses import placed_stop, stored_pose
from cucumbervision_greenhouse.store.images import DEPTH_UNIT_M
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    FruitRow,
    Point,
    StopRecord,
    key_of,
    new_key,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.methods.result import Fruit, Measurement
    from cucumbervision.run.measurer import CaptureResult, Measurer
    from cucumbervision.run.options import MeasureOptions
    from cucumbervision_greenhouse.store.images import ImageStore
    from cucumbervision_greenhouse.store.records import CaptureRecord, Round, StopRecord
    from cucumbervision_greenhouse.store.repository import Store

_PATH_POINTS = 48  # points of a stored path

AS_READ = (
    *("name", "frame", "burst_frame", "burst_size", "timestamp_s", "simulated", "source"),
    "gravity",
)


def stop_record(
    round_key: str,
    results: Sequence[CaptureResult],
    measurer: Measurer | None = None,
    *,
    key: str | None = None,
    position_sd_m: float | None = None,
    images: ImageStore | None = None,
) -> StopRecord:
    """Return a stop of what was measured there; its pictures are put into `images`.

    Parameters
    ----------
    round_key : str
        The round's key.
    results : sequence of CaptureResult
        The captures.
    measurer : Measurer, optional
        The measurer, whose software, options, networks and calibration are stored.
    key : str, optional
        The stop's own key, kept for sending it again; a new one by default.
    position_sd_m : float, optional
        How sure the position is; place and time are the first capture's. The time of a capture
        that does not say it is when its file was written, so that two programs that save the same
        files save the same stop.
    images : ImageStore, optional
        None keeps no pictures.
    """
    first = results[0].capture if results else None
    taken_s = first and (first.timestamp_s or _written_s(first.source))
    return StopRecord(
        key=key or new_key(),
        round_key=round_key,
        **asdict(first.stop if first else Stop()),
        position_sd_m=position_sd_m,
        taken_s=taken_s or time.time(),
        captures=tuple(_capture_record(result, images) for result in results),
        artifacts=() if measurer is None else _artifact_records(measurer, results),
        failures=tuple(
            {**vars(failure), "sentence": Message(failure.message).as_json()}
            for result in results
            for failure in result.failures
        ),
    )


def _written_s(source: str) -> float | None:
    """Return when a capture's file, or the manifest of its folder, was written; None if unknown."""
    if not source:
        return None
    path = Path(source)
    try:
        return (path / MANIFEST if path.is_dir() else path).stat().st_mtime
    except (OSError, ValueError):  # in memory, in a bucket, or a frame of a recording
        return None


def _capture_record(result: CaptureResult, images: ImageStore | None = None) -> CaptureRecord:
    """Return a record of one capture; its pictures are put into `images`.

    Parameters
    ----------
    result : CaptureResult
        The capture.
    images : ImageStore, optional
        None keeps no pictures.

    Raises
    ------
    StoreError
        If a picture cannot be written.
    """
    capture, pictures = result.capture, dict[str, Any]()
    if images is not None:
        pictures = {
            "color": images.put_color(capture.color),
            "depth": images.put_depth(capture.depth_m),
            "thumbnail": images.put_thumbnail(capture.color),
            "depth_unit_m": DEPTH_UNIT_M,
        }
    return CaptureRecord(
        **{name: getattr(capture, name) for name in AS_READ},
        width_px=capture.width,
        height_px=capture.height,
        fill=round(capture.fill, 4),
        camera=CameraModel.of(capture.intrinsics).model_dump(mode="json"),
        provenance=json_value(capture.provenance),
        doubts=tuple(map(str, capture.doubts)) or None,
        fruit=tuple(
            fruit_record(capture, number, fruit) for number, fruit in enumerate(result.fruit, 1)
        ),
        **pictures,
    )


def stored_capture(images: ImageStore, record: CaptureRecord, stop: StopRecord) -> Capture:
    """Return a capture of the store as a frame again.

    Its depth is as it was measured from: already scaled by the site's calibration.

    Raises
    ------
    StoredImageError
        If a picture is missing or damaged.
    InstancesError
        If it was kept without pictures.
    """
    if record.color is None or record.depth is None:
        raise InstancesError(
            "the pictures of this capture were not kept",
            source=record.name,
            remedy="measure the capture again",
        )
    return Capture(
        images.read_color(record.color),
        images.read_depth(record.depth, record.depth_unit_m or DEPTH_UNIT_M),
        CameraModel.model_validate(dict(record.camera)).intrinsics,
        stop=Stop(stop.row, stop.side, stop.position_m, stop.step),
        provenance=dict[str, Any](record.provenance),
        doubts=tuple(map(Doubt, record.doubts or ())),
        **{name: getattr(record, name) for name in AS_READ},
    )


def fruit_record(capture: Capture, number: int, fruit: Fruit) -> FruitRow:
    """Return the row of a capture's fruit by its number from 1, with mask and path.

    The fruit's offset along the row is how far right of the camera its middle lies; who knows that
    the row runs the other way, or the camera's pose, replaces it.
    """
    keypoints, chosen = fruit.instance.keypoints, fruit.selected
    cells: dict[str, Any] = stored_row(capture, number, fruit)
    return FruitRow(
        **{**cells, "offset_m": cells["centre_x_m"]},
        keypoints=() if keypoints is None else _rows_of(keypoints),
        mask=None if fruit.mask is None else encode_rle(fruit.mask),
        **({} if chosen is None else _path_of(chosen)),
    )


def instance_of(record: FruitRow, shape: tuple[int, int]) -> Instance:
    """Return a stored fruit as an instance in a picture of this height and width."""
    edges = (record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px)
    return Instance(
        np.array(edges),
        record.score,
        record.label,
        mask=None if record.mask is None else decode_rle(record.mask, *shape),
        mask_source=MaskSource(record.mask_source) if record.mask_source else None,
        keypoints=np.array(record.keypoints) if record.keypoints else None,
    )


_CALIBRATION = "calibration"


def stored_calibration(stop: StopRecord) -> SiteCalibration | None:
    """Return the site's calibration that a stop was measured with; None without one."""
    details = [artifact.details for artifact in stop.artifacts if artifact.kind == _CALIBRATION]
    return SiteCalibration.model_validate(dict(details[0])) if details else None


def _artifact_records(
    measurer: Measurer, results: Sequence[CaptureResult]
) -> tuple[ArtifactRecord, ...]:
    """Return software, configuration, networks and calibration that a measurer measures with."""
    options, site = measurer.options, measurer.site
    records = [
        ArtifactRecord("software", f"cucumbervision {__version__}"),
        ArtifactRecord("config", "measure", options.sha256, options.as_json()),
    ]
    models = [model for result in results for model in result.models]
    for model in [candidate for k, candidate in enumerate(models) if candidate not in models[:k]]:
        details = {k: v for k, v in model.items() if k not in {"name", "sha256"}}
        sha256 = str(model.get("sha256") or "")
        records.append(ArtifactRecord("model", str(model["name"]), sha256, json_value(details)))
    if site is not None:
        details = site.model_dump(mode="json")
        records.append(ArtifactRecord(_CALIBRATION, site.name, site.sha256, details))
    return tuple(records)


def _path_of(measurement: Measurement) -> dict[str, Any]:
    """Return the line that was measured, and the tube's diameter along it."""
    fit, path = measurement.fit, measurement.path_m
    diameter: NDArray[np.float64] | None = None
    if fit is not None:
        path = fit.traits.axis_m
        diameter = np.interp(arc_positions(path), fit.traits.along_m, fit.traits.diameter_m)
    if path is None or not len(path):
        return {}
    points = np.linspace(0, len(path) - 1, min(len(path), _PATH_POINTS)).round().astype(int)
    kept = np.unique(points)
    return {
        "path_m": _rows_of(np.round(path[kept], 6)),
        "diameter_m": () if diameter is None else tuple(np.round(diameter[kept], 6).tolist()),
    }


def _rows_of(values: NDArray[np.float64]) -> tuple[Point, ...]:
    return tuple(tuple(line) for line in values.tolist())


_SAME_BOX = 0.5  # intersection over union


def measure_round_again(
    store: Store,
    old: Round,
    options: MeasureOptions,
    report: Callable[[int, int], None] | None = None,
    loop: LoopOptions | None = None,
) -> tuple[str, list[Failure]]:
    """Measure the stored captures of a round again, into a new round that takes its place.

    The old round is deleted, which can be undone. A fruit that somebody accepted, rejected, picked
    or drew keeps that; one that is not found again is measured in its old outline.

    Parameters
    ----------
    store : Store
        Where the round is.
    old : Round
        The round.
    options : MeasureOptions
        How to measure.
    report : callable, optional
        Given how many stops are done, and of how many.
    loop : LoopOptions, optional
        Options of the loop.

    Returns
    -------
    key : str
        Of the new round; of the old one where anything failed, and nothing is changed.
    failures : list of Failure
        Why.
    """
    measurer, loop = Measurer(options), loop or LoopOptions()
    new, failures = replace(old, key=new_key(), stops=0, fruit=0, last_s=None), list[Failure]()
    stops = {view.key: store.stop(view.key) for view in store.stops(old.key)}

    def items() -> Iterator[Listed]:
        for key, stop in stops.items():
            for capture in stop.captures:
                load = partial(_uncalibrated, store, capture, stop, options)
                yield Listed(key, CaptureRef(capture.name, capture.frame or 0, load), capture.name)

    measured = measure_all(items(), ResultWorker(measurer), loop.engine, loop.is_cancelled)
    again: dict[str, list[CaptureResult]] = {}
    for key, group in groupby(measured, lambda pair: pair[0].input):
        for _, outcome in group:
            if outcome.value is None or outcome.value.error is not None:
                failures += outcome.failures
            else:
                again.setdefault(key, []).append(outcome.value)
        if report is not None:
            report(len(again), len(stops))
    if failures or len(again) < len(stops):
        return old.key, failures
    with Boundary(failures, store.name, old.name or old.key):
        store.save_round(new)
        for key, stop in stops.items():
            _save_again(store, new.key, stop, again[key], measurer)
        store.delete_round(old.key)
    return (old.key if failures else new.key), failures


def _uncalibrated(
    store: Store, record: CaptureRecord, stop: StopRecord, options: MeasureOptions
) -> Capture:
    """Return a stored capture as it was before a calibration, with the data set's own masks."""
    capture = stored_capture(store.images, record, stop)
    if options.camera_up is not None and capture.gravity in GRAVITY_BY_EDGE.values():
        capture = replace(capture, gravity=None)  # an option's, which is named anew
    if (site := stored_calibration(stop)) is not None:
        capture = replace(capture, depth_m=capture.depth_m * np.float32(site.depth_divisor))
        if site.lens is not None:
            capture = replace(capture, intrinsics=site.camera.intrinsics.intrinsics)
    masks = [
        decode_rle(fruit.mask, capture.height, capture.width)
        for fruit in record.fruit
        if fruit.mask is not None and fruit.mask_source == MaskSource.DATASET
    ]
    return replace(capture, masks=tuple(masks))


def _save_again(
    store: Store, round_key: str, stop: StopRecord, results: list[CaptureResult], measurer: Measurer
) -> None:
    """Save a stop of the new round, at its place, with what people decided about its fruit."""
    views = [
        view for view in store.detections(stop.round_key, shapes=True) if view.stop_key == stop.key
    ]
    key, decided = key_of(round_key, stop.key), []
    for place, (result, taken) in enumerate(zip(results, stop.captures, strict=True)):
        fruit = list(result.fruit)
        boxes = np.array([found.instance.box for found in fruit]).reshape(-1, 4)
        for view in (view for view in views if view.capture == taken.name):
            if not (view.verdict or view.corrected or view.picked_s is not None):
                continue
            old = instance_of(view, result.capture.depth_m.shape)
            overlap = box_ious(old.box[None], boxes)[0] if len(boxes) else np.zeros(0)
            number = int(overlap.argmax()) if overlap.max(initial=0.0) >= _SAME_BOX else len(fruit)
            if view.corrected or number == len(fruit):
                fruit[number : number + 1] = [measurer.measure_instance(result.capture, old)]
            decided.append((view, key_of("fruit", key, place, number + 1)))
        results[place] = replace(result, fruit=tuple(fruit))
    new = stop_record(round_key, results, measurer, key=key, images=store.images)
    new = placed_stop(new, stored_pose(stop.pose_now, stop.side))
    placed = replace(
        stop,
        key=key,
        round_key=round_key,
        captures=new.captures,
        artifacts=new.artifacts,
        failures=new.failures,
        pose=stop.pose_now,
        mirrored=False,
    )
    store.save_stop(placed)
    for view, fruit_key in decided:
        if view.verdict:
            store.set_verdict([fruit_key], view.verdict)
        if view.picked_s is not None:
            store.pick([fruit_key], at_s=view.picked_s)
