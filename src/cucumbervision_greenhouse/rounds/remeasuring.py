"""Measure a stored round again, into a new version of itself; the old one stays as it was."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.source import CaptureRef
from cucumbervision.fruit.instance import MaskSource
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.fruit.masks import box_ious
from cucumbervision.run.batch import LoopOptions, ResultWorker, measure_all
from cucumbervision.run.inputs import Listed
from cucumbervision.run.measurer import Boundary, Failure, Measurer
from cucumbervision.run.options import GRAVITY_BY_EDGE
from cucumbervision_greenhouse.rounds.poses import placed_stop, stored_pose
from cucumbervision_greenhouse.rounds.stop_records import (
    instance_of,
    stop_record,
    stored_calibration,
    stored_capture,
)
from cucumbervision_greenhouse.store.records import key_of, new_key

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from cucumbervision.capture.frames import Capture
    from cucumbervision.run.measurer import CaptureResult
    from cucumbervision.run.options import MeasureOptions
    from cucumbervision_greenhouse.store.records import CaptureRecord, Round, StopRecord
    from cucumbervision_greenhouse.store.repository import Store

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
