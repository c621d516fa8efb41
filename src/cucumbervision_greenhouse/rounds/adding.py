"""Add captures to a round: measure each, place it along the row, and save it as a stop."""

from __future__ import annotations

import hashlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from cucumbervision._version import __version__
from cucumbervision.about import code_sha256
from cucumbervision.accuracy.calibration_file import SiteCalibration
from cucumbervision.arrays import Array
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Capture, Doubt, Stop
from cucumbervision.capture.readers.native import MANIFEST
from cucumbervision.capture.source import CaptureRef
from cucumbervision.errors import InstancesError, Message, RoundError
from cucumbervision.files import json_value
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.mask_codes import decode_rle, encode_rle
from cucumbervision.fruit.masks import box_ious
from cucumbervision.methods.result import Fruit, Measurement
from cucumbervision.run.batch import Item, LoopOptions, ResultWorker, measure_all, read_captures
from cucumbervision.run.fields import stored_row
from cucumbervision.run.measurer import Boundary, CaptureResult, Failure, Measurer
from cucumbervision.run.options import GRAVITY_BY_EDGE, MeasureOptions
from cucumbervision.tube.shape import arc_positions
from cucumbervision_greenhouse.rounds import walking
from cucumbervision_greenhouse.store.images import DEPTH_UNIT_M, ImageStore
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    FruitRow,
    Point,
    Round,
    StopRecord,
    key_of,
    new_key,
)
from cucumbervision_greenhouse.store.repository import Store

Report: TypeAlias = Callable[["Added"], None]

_POSE_COLUMNS = ("height_m", "yaw_deg", "pitch_deg", "roll_deg")
_PATH_POINTS = 48  # points of a stored path
_CALIBRATION = "calibration"
_SAME_BOX = 0.5  # intersection over union

AS_READ = (
    *("name", "frame", "burst_frame", "burst_size", "timestamp_s", "simulated", "source"),
    "gravity",
)


@dataclass(frozen=True)
class Place:
    """Where captures were taken, unless their own files or a pose file give it.

    Parameters
    ----------
    row, side : str, optional
        Row of the house, and side of the row.
    position_m, spacing_m : float, optional
        Of the first capture along the row, and how far each next one is from the last.
    position_sd_m : float
        How sure positions are.
    sign : int, optional
        1 where positions get higher to the right in the image, else -1; by default as
        `sign_of_side` returns for the side.
    poses : mapping of str to PoseLine
        Poses by the capture's name; they take precedence.
    """

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    spacing_m: float | None = None
    position_sd_m: float = walking.MIDDLE_SD_M
    sign: int | None = None
    poses: Mapping[str, walking.PoseLine] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse a place that no stop can have."""
        Stop(self.row, self.side, self.position_m)

    def stop(self, capture: Capture, key: str, round_key: str, number: int = 0) -> StopRecord:
        """Return the stop of a capture, before it is measured.

        The time of a capture that has none is when its file was written, so that two programs that
        save the same files save the same stop.

        Parameters
        ----------
        capture : Capture
            The frame.
        key, round_key : str
            Keys of the stop and its round.
        number : int
            Number of earlier captures, for its position and step if nothing else gives them.

        Raises
        ------
        RoundError
            If a pose file has no line for it.
        """
        stop, line = capture.stop, self.poses.get(capture.name)
        if self.poses and line is None:
            raise RoundError(
                "the pose file has no line for this capture",
                source=capture.name,
                remedy="add one, or leave the pose file out",
            )
        position_m, sd_m, turned = stop.position_m, self.position_sd_m, {}
        if self.position_m is not None:
            position_m = self.position_m + number * (self.spacing_m or 0.0)
        row, side = self.row or stop.row, self.side or stop.side
        if line is not None:
            row, side, position_m = line.row or row, line.side or side, line.position_m
            sd_m = line.position_sd_m
            turned = {name: getattr(line, name) or 0.0 for name in _POSE_COLUMNS}
        sign = walking.sign_of_side(side) if self.sign is None else self.sign
        pose = walking.pose_matrix(position_m or 0.0, sign, **turned)
        camera = CameraModel.of(capture.intrinsics).model_dump(mode="json")
        return StopRecord(
            **vars(Stop(row, side, position_m, number + 1 if stop.step is None else stop.step)),
            key=key,
            round_key=round_key,
            position_sd_m=None if position_m is None else sd_m,
            taken_s=capture.timestamp_s or _written_s(capture.source) or time.time(),
            pose=tuple(pose.round(9).ravel().tolist()),
            captures=(CaptureRecord(capture.name, camera=camera),),
        )


@dataclass(frozen=True)
class Added:
    """The outcome of one capture.

    Parameters
    ----------
    name : str
        The capture, or the input that could not be read.
    stop_key : str
        Its stop; empty where there is none.
    fruit : int
        Number of fruit in it; 0 if it was saved before.
    new : bool
        Whether it was saved by this call.
    deleted : bool
        Whether it was saved before and deleted; undo the deletion to restore it.
    failure : Failure, optional
        Why not.
    note : str
        Why nothing was measured in a capture that was saved nevertheless.
    """

    name: str
    stop_key: str = ""
    fruit: int = 0
    new: bool = False
    deleted: bool = False
    failure: Failure | None = None
    note: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class RoundCapture(CaptureRef):
    """A capture on its way into a round.

    Parameters
    ----------
    name, frame, load, location, parts, input
        As in `CaptureRef`.
    stop : StopRecord
        The stop that it is or will be, as far as it is known before it is measured.
    is_deleted : bool, optional
        Whether its stop was deleted; None if the round has no such stop.
    """

    stop: StopRecord
    is_deleted: bool | None = None

    @classmethod
    def to_add(
        cls,
        store: Store,
        round_key: str,
        capture: Capture,
        number: int = 0,
        place: Place | None = None,
    ) -> RoundCapture:
        """Return a capture with its state in the round; its key is that of its content.

        Parameters
        ----------
        store, round_key : Store, str
            The store, and the round, saved before.
        capture : Capture
            The frame.
        number, place
            As for `Place.stop`.

        Raises
        ------
        CucumberVisionError
            If the store cannot be read, or a pose file has no line for the capture.
        """
        key = key_of(round_key, capture.name, capture_sha256(capture))
        stop = (place or Place()).stop(capture, key, round_key, number)
        return cls.of(capture, stop=stop, is_deleted=store.stop_is_deleted(key))


class _New(ResultWorker):
    """Measures captures that are new in a round."""

    def __call__(self, item: Item) -> CaptureResult | Failure | None:
        """Measure a capture, unless it is in the round or was deleted from it."""
        if isinstance(item, RoundCapture) and item.is_deleted is not None:
            return None
        return super().__call__(item)


def add_captures(
    store: Store,
    round_key: str,
    inputs: Sequence[Path],
    options: MeasureOptions,
    place: Place | None = None,
    report: Report | None = None,
    loop: LoopOptions | None = None,
) -> list[Added]:
    """Measure captures and save each as a stop of a round.

    A capture that the round has already, or that was deleted from it, stays as it is. One that
    cannot be read or measured, or lies where the same camera took another, is noted, and the others
    go on.

    Parameters
    ----------
    store : Store
        Where to.
    round_key : str
        The round, saved before.
    inputs : sequence of Path
        Folders and files that `open_source` knows.
    options : MeasureOptions
        How to measure.
    place : Place, optional
        Where they were taken.
    report : callable, optional
        Called after each capture; for progress bars.
    loop : LoopOptions, optional
        Options of the loop.

    Returns
    -------
    list of Added
        One a capture, in order; none for those before which the loop was stopped.

    Raises
    ------
    CucumberVisionError
        If nothing can be measured at all: a network or the calibration cannot be loaded.
    """
    measurer, done, loop = Measurer(options), list[Added](), loop or LoopOptions()

    def items() -> Iterator[RoundCapture | Failure]:
        for number, read in enumerate(read_captures(inputs, options.reading)):
            if isinstance(read, Failure):
                yield read
                continue
            failures: list[Failure] = []
            with Boundary(failures, read.source, read.name):
                yield RoundCapture.to_add(store, round_key, read, number, place)
            yield from failures

    captures = measure_all(items(), _New(measurer), loop.engine, loop.is_cancelled)
    for item, result in captures:
        failures, added = [result] if isinstance(result, Failure) else [], None
        if isinstance(item, RoundCapture) and not isinstance(result, Failure):
            if result is None and item.is_deleted is None:  # stopped before its turn
                continue
            with Boundary(failures, item.input, item.name):
                added = _added(store, item, result, measurer)
        if failures:
            added = Added(failures[0].capture or failures[0].input, failure=failures[0])
        if added is not None:
            done.append(added)
            if report is not None:
                report(added)
    return done


def _added(
    store: Store, item: RoundCapture, result: CaptureResult | None, measurer: Measurer
) -> Added:
    """Save the result of a capture, unless its round has it; return the outcome.

    Raises
    ------
    CucumberVisionError
        If nothing was measured, its place is taken, or it cannot be saved.
    """
    # The same capture may be given twice.
    if result is None or store.stop_is_deleted(item.stop.key) is not None:
        return Added(item.name, item.stop.key, deleted=bool(item.is_deleted))
    walking.refuse_taken(store, item.stop)
    return save_measured(store, item.stop, result, measurer)


def save_measured(
    store: Store, stop: StopRecord, result: CaptureResult, measurer: Measurer
) -> Added:
    """Save a capture as a stop with what was measured in it, or why nothing was.

    Raises
    ------
    StoreError
        If it cannot be saved.
    """
    new = store.save_stop(measured_stop(stop, [result], measurer, store.images))
    note = "" if result.error is None else result.error.message
    fruit = len(result.fruit) if new else 0
    return Added(result.capture.name, stop.key, fruit=fruit, new=new, note=note)


def capture_sha256(capture: Capture) -> str:
    """Return the SHA-256 of a capture's colour and depth, hexadecimal."""
    digest = hashlib.sha256(np.ascontiguousarray(capture.color).tobytes())
    digest.update(np.ascontiguousarray(capture.depth_m).tobytes())
    return digest.hexdigest()


def measured_stop(
    stop: StopRecord,
    results: Sequence[CaptureResult],
    measurer: Measurer | None = None,
    images: ImageStore | None = None,
) -> StopRecord:
    """Return a stop with what was measured there; its images are put into `images`.

    Parameters
    ----------
    stop : StopRecord
        The stop.
    results : sequence of CaptureResult
        The captures.
    measurer : Measurer, optional
        The measurer, whose software, options, networks and calibration are stored.
    images : ImageStore, optional
        None keeps no images.

    Raises
    ------
    StoreError
        If an image cannot be written.
    """
    pose = walking.stored_pose(stop.pose, stop.side)
    return replace(
        stop,
        captures=tuple(_capture_record(result, pose, images) for result in results),
        artifacts=() if measurer is None else _artifact_records(measurer, results),
        failures=tuple(
            {**vars(failure), "sentence": Message(failure.message).as_json()}
            for result in results
            for failure in result.failures
        ),
    )


def _written_s(source: str) -> float | None:
    """Return when a capture's file, or the manifest of its folder, was written; None if unknown."""
    path = Path(source)
    with suppress(OSError, ValueError):  # in memory, in a bucket, or a frame of a recording
        return (path / MANIFEST if path.is_dir() else path).stat().st_mtime if source else None
    return None


def _capture_record(result: CaptureResult, pose: Array, images: ImageStore | None) -> CaptureRecord:
    capture, stored = result.capture, dict[str, Any]()
    if images is not None:
        stored = {
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
            fruit_record(capture, number, fruit, pose)
            for number, fruit in enumerate(result.fruit, 1)
        ),
        **stored,
    )


def stored_capture(images: ImageStore, record: CaptureRecord, stop: StopRecord) -> Capture:
    """Return a capture of the store as a frame again.

    Its depth is as it was measured from: already scaled by the site's calibration.

    Raises
    ------
    StoredImageError
        If an image is missing or damaged.
    InstancesError
        If it was kept without images.
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


def fruit_record(capture: Capture, number: int, fruit: Fruit, pose: Array) -> FruitRow:
    """Return the row of a capture's fruit by its number from 1, with mask and path.

    Parameters
    ----------
    capture, number, fruit
        As above.
    pose : ndarray of float64, shape (4, 4)
        The camera's, which gives the fruit's offset along the row.
    """
    keypoints, chosen = fruit.instance.keypoints, fruit.selected
    cells: dict[str, Any] = stored_row(capture, number, fruit)
    row = FruitRow(
        **cells,
        keypoints=() if keypoints is None else _rows_of(keypoints),
        mask=None if fruit.mask is None else encode_rle(fruit.mask),
        **({} if chosen is None else _path_of(chosen)),
    )
    if (offset := walking.offset_of(row, pose)) is not None:
        row.offset_m, row.offset_sd_m = (round(float(part[0]), 5) for part in offset)
    return row


def instance_of(record: FruitRow, shape: tuple[int, int]) -> Instance:
    """Return a stored fruit as an instance in an image of this height and width."""
    edges = (record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px)
    return Instance(
        np.array(edges),
        record.score,
        record.label,
        mask=None if record.mask is None else decode_rle(record.mask, *shape),
        mask_source=MaskSource(record.mask_source) if record.mask_source else None,
        keypoints=np.array(record.keypoints) if record.keypoints else None,
    )


def stored_calibration(stop: StopRecord) -> SiteCalibration | None:
    """Return the site's calibration that a stop was measured with; None without one."""
    details = [artifact.details for artifact in stop.artifacts if artifact.kind == _CALIBRATION]
    return SiteCalibration.model_validate(dict(details[0])) if details else None


def _artifact_records(
    measurer: Measurer, results: Sequence[CaptureResult]
) -> tuple[ArtifactRecord, ...]:
    """Return software, configuration, networks and calibration that a measurer measures with."""
    options, site = measurer.options, measurer.site
    made = [
        ArtifactRecord("software", f"cucumbervision {__version__}", code_sha256()),
        ArtifactRecord("config", "measure", options.sha256, options.as_json()),
    ]
    models = [model for result in results for model in result.models]
    for model in [candidate for k, candidate in enumerate(models) if candidate not in models[:k]]:
        details = {k: v for k, v in model.items() if k not in {"name", "sha256"}}
        sha256 = str(model.get("sha256") or "")
        made.append(ArtifactRecord("model", str(model["name"]), sha256, json_value(details)))
    if site is not None:
        details = site.model_dump(mode="json")
        made.append(ArtifactRecord(_CALIBRATION, site.name, site.sha256, details))
    return tuple(made)


def _path_of(measurement: Measurement) -> dict[str, Any]:
    """Return the line that was measured, and the tube's diameter along it."""
    fit, path = measurement.fit, measurement.path_m
    diameter: Array | None = None
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


def _rows_of(values: Array) -> tuple[Point, ...]:
    return tuple(tuple(line) for line in values.tolist())


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
    stops = {stop.key: stop for stop in store.stops(old.key)}
    views: dict[str, list[FruitRow]] = defaultdict(list)
    for view in store.detections(old.key, shapes=True):
        views[view.stop_key].append(view)

    def items() -> Iterator[CaptureRef]:
        for key, stop in stops.items():
            for capture in stop.captures:
                load = partial(_uncalibrated, store, capture, stop, views[key], options)
                yield CaptureRef(capture.name, capture.frame or 0, load, input=key)

    again: dict[str, list[CaptureResult]] = {}
    for item, result in measure_all(
        items(), ResultWorker(measurer), loop.engine, loop.is_cancelled
    ):
        if isinstance(result, Failure):
            failures.append(result)
        elif result is not None:
            again.setdefault(item.input, []).append(result)
        if report is not None:
            report(len(again), len(stops))
    if failures or len(again) < len(stops):
        return old.key, failures
    with Boundary(failures, store.name, old.name or old.key):
        store.save_round(new)
        for key, stop in stops.items():
            _save_again(store, new.key, stop, views[key], again[key], measurer)
        store.delete_round(old.key)
    return (old.key if failures else new.key), failures


def _uncalibrated(
    store: Store,
    record: CaptureRecord,
    stop: StopRecord,
    views: Sequence[FruitRow],
    options: MeasureOptions,
) -> Capture:
    """Return a stored capture as it was before a calibration, with the data set's own masks."""
    capture = stored_capture(store.images, record, stop)
    if options.camera_up is not None and capture.gravity in GRAVITY_BY_EDGE.values():
        capture = replace(capture, gravity=None)  # an option's, which is named anew
    if (site := stored_calibration(stop)) is not None:
        capture = replace(capture, depth_m=capture.depth_m * np.float32(site.depth_divisor))
        if site.lens is not None:
            capture = replace(capture, intrinsics=site.camera.intrinsics.intrinsics)
    fruit_of = (view for view in views if view.capture == record.name)
    fruit = (instance_of(view, capture.depth_m.shape) for view in fruit_of)
    masks = (x.mask for x in fruit if x.mask_source is MaskSource.DATASET)
    return replace(capture, masks=tuple(mask for mask in masks if mask is not None))


def _save_again(
    store: Store,
    round_key: str,
    stop: StopRecord,
    views: Sequence[FruitRow],
    results: list[CaptureResult],
    measurer: Measurer,
) -> None:
    """Save a stop of the new round, at its place, with what people decided about its fruit."""
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
    now = replace(stop, key=key, round_key=round_key, pose=stop.pose_now, mirrored=False)
    store.save_stop(measured_stop(now, results, measurer, store.images))
    for view, fruit_key in decided:
        if view.verdict:
            store.set_verdict([fruit_key], view.verdict)
        if view.picked_s is not None:
            store.pick([fruit_key], at_s=view.picked_s)
