"""Measure stops again: those whose inputs have changed, or all of a round."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.source import CaptureRef
from cucumbervision.errors import CucumberVisionError
from cucumbervision.instances.boxes import box_ious
from cucumbervision.instances.instance import MaskSource
from cucumbervision.instances.mask_codes import decode_rle
from cucumbervision.pipeline.batch import (
    LoopOptions,
    ResultWorker,
    measure_all,
)
from cucumbervision.pipeline.inputs import Listed
from cucumbervision.pipeline.measurer import Boundary, Failure, Measurer
from cucumbervision.pipeline.options import GRAVITY_BY_EDGE
from cucumbervision_greenhouse.rounds.poses import placed_fruit, placed_stop, stored_pose
from cucumbervision_greenhouse.rounds.stop_records import (
    fruit_record,
    instance_of,
    stop_record,
    stored_calibration,
    stored_capture,
)
from cucumbervision_greenhouse.store.views import DetectionFilter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from cucumbervision.capture.frames import Capture
    from cucumbervision.pipeline.measurer import CaptureResult
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision_greenhouse.store.records import CaptureRecord, DetectionRecord, StopRecord
    from cucumbervision_greenhouse.store.repository import Store

_SAME_BOX = 0.5  # intersection over union


def measure_round_again(
    store: Store,
    round_key: str,
    options: MeasureOptions,
    report: Callable[[int, int], None] | None = None,
    loop: LoopOptions | None = None,
) -> tuple[int, list[Failure]]:
    """Measure all stops of a round again from the captures that the store keeps.

    Parameters
    ----------
    store : Store
        Where the round is.
    round_key : str
        The round.
    options : MeasureOptions
        How to measure.
    report : callable, optional
        Given how many stops are done, and of how many.
    loop : LoopOptions, optional
        Options of the loop.

    Returns
    -------
    done : int
        How many stops were measured again.
    failures : list of Failure
        Faults of the other stops, which are unchanged.
    """
    measurer, loop, done = Measurer(options), loop or LoopOptions(), 0
    failures: list[Failure] = []
    stops = {view.key: f"stop {view.step or view.key[:8]}" for view in store.stops(round_key)}

    def items() -> Iterator[Listed | Failure]:
        for key, name in stops.items():
            try:
                stop = store.stop(key)
            except CucumberVisionError as error:
                yield Failure.of(error, key, name)
                continue
            for capture in stop.captures:
                load = partial(_uncalibrated, store, capture, stop, options)
                ref = CaptureRef(capture.name, capture.frame or 0, load)
                yield Listed(key, ref, capture.name)

    measured = measure_all(items(), ResultWorker(measurer), loop.engine, loop.is_cancelled)
    for number, (key, group) in enumerate(groupby(measured, lambda pair: pair[0].input), 1):
        outcomes = [outcome for _, outcome in group]
        results = [outcome.value for outcome in outcomes if outcome.value is not None]
        failures += [
            why for outcome in outcomes if outcome.value is None for why in outcome.failures
        ]
        if len(results) == len(outcomes):
            with Boundary(failures, store.name, stops[key]):
                measure_stop_again(store, key, results, measurer)
                done += 1
        if report is not None:
            report(number, len(stops))
    return done, failures


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


def measure_stop_again(
    store: Store, key: str, results: Sequence[CaptureResult], measurer: Measurer
) -> int:
    """Save a stop as it was measured again, and return how many fruit it shows; logged.

    Its place stays as it is. A fruit that is found again keeps its key, and with it verdict, pick
    and links. A fruit with a manual decision that is not found again is measured with its old
    mask; a corrected mask is measured as it is.

    Parameters
    ----------
    store : Store
        Where it is.
    key : str
        The stop's.
    results : sequence of CaptureResult
        The new results of its captures, in order.
    measurer : Measurer
        The measurer.

    Raises
    ------
    CucumberVisionError
        If one of them could not be measured; the stop is then unchanged.
    """
    stop = store.stop(key)
    views = store.detections(stop.round_key, DetectionFilter(stop_key=key))
    links = [link for link in store.links(stop.round_key) if link.by_hand]
    decided = {end for link in links for end in (link.first, link.second)}
    decided |= {
        view.key for view in views if view.verdict or view.corrected or view.picked_s is not None
    }
    by_hand = store.corrected(stop.round_key)
    results_with_old: list[CaptureResult] = []
    same: dict[str, tuple[str, int]] = {}
    corrected: dict[str, DetectionRecord] = {}
    for result, taken in zip(results, stop.captures, strict=True):
        if result.error is not None:
            raise CucumberVisionError(result.error.message, source=taken.name)
        record_of_number = {record.number: record for record in taken.fruit}
        before = {
            view.key: record_of_number[view.record.number]
            for view in views
            if view.capture == taken.name
        }
        result, numbers = _with_decided_fruit(result, before, decided, measurer)
        same |= {key: (taken.name, number) for key, number in numbers.items()}
        for fruit_key in by_hand.keys() & numbers.keys():
            fruit = measurer.measure_instance(
                result.capture, instance_of(by_hand[fruit_key], result.capture.depth_m.shape)
            )
            record = fruit_record(result.capture, numbers[fruit_key], fruit)
            corrected[fruit_key] = placed_fruit(record, stored_pose(stop.pose, stop.side))
        results_with_old.append(result)
    store.measure_again(_stop_of(stop, results_with_old, measurer, store), same, corrected)
    return sum(len(result.fruit) for result in results_with_old)


def _with_decided_fruit(
    result: CaptureResult,
    before: Mapping[str, DetectionRecord],
    decided: set[str],
    measurer: Measurer,
) -> tuple[CaptureResult, dict[str, int]]:
    """Return a result with fruit that must not be lost, and the numbers of old fruit by key."""
    from scipy.optimize import linear_sum_assignment

    fruit, numbers = list(result.fruit), dict[str, int]()
    shape = (result.capture.height, result.capture.width)
    old = {key: instance_of(record, shape) for key, record in before.items()}
    if fruit and old:
        boxes = np.array([instance.box for instance in old.values()])
        overlap = box_ious(boxes, np.array([measurement.instance.box for measurement in fruit]))
        keys = list(old)
        for i, j in zip(*linear_sum_assignment(overlap, maximize=True), strict=True):
            if overlap[i, j] >= _SAME_BOX:
                numbers[keys[i]] = int(j) + 1
    for key in sorted(decided & (old.keys() - numbers.keys())):
        fruit.append(measurer.measure_instance(result.capture, old[key]))
        numbers[key] = len(fruit)
    return replace(result, fruit=tuple(fruit)), numbers


def _stop_of(
    stop: StopRecord, results: Sequence[CaptureResult], measurer: Measurer, store: Store
) -> StopRecord:
    """Return the record of a stop that was measured again, with its place unchanged."""
    new = stop_record(stop.round_key, results, measurer, key=stop.key, images=store.images)
    new = placed_stop(new, stored_pose(stop.pose, stop.side))
    return replace(stop, captures=new.captures, artifacts=new.artifacts, failures=new.failures)
