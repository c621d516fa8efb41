from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from demo_captures import SCENES, place
from tests.accuracy.test_calibration_file import entry, site
from tests.greenhouse.conftest import add_one, measure_waiting, whole_stop

from cucumbervision import errors
from cucumbervision.accuracy.calibration_file import write_site_calibration
from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.crop.profiles import load_profile
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.flags import Flag
from cucumbervision.networks.registry import load_registry
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.measuring import SharedMeasurer, is_doubtful
from cucumbervision_greenhouse.round_view import doubtful
from cucumbervision_greenhouse.rounds.adding import stored_calibration, stored_capture
from cucumbervision_greenhouse.rounds.forecasting import fruit_states
from cucumbervision_greenhouse.rounds.fruit_table import hanging_lengths_m
from cucumbervision_greenhouse.store.records import Round, Verdict, key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures

OPTIONS = MeasureOptions(instances="auto")
WALK = key_of("walk")


@pytest.fixture(scope="module")
def measurer() -> SharedMeasurer:
    return SharedMeasurer(load_registry())


def test_a_stop_is_saved_with_its_fruit_where_they_hang(store: Store) -> None:
    capture = next(iter(open_source(example_captures()))).load()
    one = Round(key_of("other"))
    store.save_round(one)
    spots = Stop("4", "left", 2.0, 1), Stop("4", "right", 2.0, 2)
    for spot in spots:
        taken = add_one(store, one.key, replace(capture, stop=spot), OPTIONS)
        assert not taken.note
    left, right = (
        [v for v in store.detections(one.key) if v.side == side] for side in ("left", "right")
    )
    # The first fruit of the bench lies 16 cm left of the camera: behind it where the row is on
    # the left, before it on the right.
    assert left[0].along_m == pytest.approx(2.0 - 0.16, abs=0.01)
    assert right[0].along_m == pytest.approx(2.0 + 0.16, abs=0.01)


def test_what_cannot_be_measured_is_saved_with_the_reason(store: Store) -> None:
    capture = replace(next(iter(open_source(example_captures()))).load(), masks=())
    options = replace(OPTIONS, instances="dataset")
    taken = add_one(store, WALK, capture, options)
    assert "no masks" in taken.note
    stop = store.stop(taken.stop_key)
    assert stop.captures[0].color is not None
    assert stop.failures[0]["error"] == "InstancesError"


def test_what_is_no_fruit_of_the_picture_is_kept_as_a_failure(store: Store, tmp_path: Path) -> None:
    capture = next(iter(open_source(example_captures()))).load()
    boxes = ([300.0, 100.0, 200.0, 60.0], [5000.0, 100.0, 200.0, 60.0])
    instances = {
        "images": [{"id": 1, "file_name": capture.name, "width": 848, "height": 480}],
        "categories": [{"id": 1, "name": "cucumber"}],
        "annotations": [
            {"id": k, "image_id": 1, "category_id": 1, "bbox": box} for k, box in enumerate(boxes)
        ],
    }
    path = tmp_path / "boxes.json"
    path.write_text(json.dumps(instances))
    taken = add_one(store, WALK, capture, replace(OPTIONS, instances=str(path)))
    assert not taken.note
    stop = store.stop(taken.stop_key)
    assert stop.fruit == 1
    assert len(stop.failures) == 1


def test_a_stored_capture_is_the_frame_again(store: Store) -> None:
    first = next(iter(open_source(example_captures()))).load()
    stop = next(
        s for v in store.stops(WALK) if (s := store.stop(v.key)).captures[0].name == first.name
    )
    again = stored_capture(store.images, stop.captures[0], stop)
    assert (again.color == first.color).all()
    assert np.abs(again.depth_m - first.depth_m).max() <= 0.00006
    assert again.intrinsics == first.intrinsics
    with pytest.raises(errors.InstancesError, match="not kept"):
        stored_capture(store.images, replace(stop.captures[0], color=None), stop)


def test_a_mask_is_corrected_by_a_tap_and_by_a_box(store: Store, measurer: SharedMeasurer) -> None:
    bench = [v for v in store.detections(WALK) if v.capture == "simulated-bench"]
    detail = store.detection(bench[2].key)
    record = detail.view
    assert record.mask is not None
    capture = stored_capture(store.images, detail.capture, detail.stop)
    true = decode_rle(record.mask, capture.height, capture.width)
    ys, xs = np.nonzero(true)
    box = (xs.min() - 3.0, ys.min() - 3.0, xs.max() + 3.0, ys.max() + 3.0)
    tapped = measurer.mask_of(capture, (float(np.median(xs)), float(np.median(ys))))
    boxed = measurer.mask_of(capture, box=box)
    for mask in (tapped, boxed):
        assert (mask & true).sum() / (mask | true).sum() > 0.9
    measurer.correct(store, detail, capture, boxed, OPTIONS)
    (now,) = [v for v in store.detections(WALK) if v.key == detail.view.key]
    assert now.corrected
    assert now.mask_source == MaskSource.SAM
    thread_m = place(SCENES[2].fruit[2]).thread_m
    assert now.thread_m == pytest.approx(thread_m, rel=0.06)
    assert now.along_m == pytest.approx(bench[2].along_m, abs=0.01)
    store.undo(WALK)
    assert not store.detection(detail.view.key).view.corrected


def test_a_fruit_that_was_not_found_is_added_by_a_box(
    store: Store, measurer: SharedMeasurer
) -> None:
    capture = replace(next(iter(open_source(example_captures()))).load(), name="without finds")
    true = capture.masks[0]
    one = Round(key_of("missed"))
    store.save_round(one)
    blind = replace(OPTIONS, instances="models", confidence=0.999)
    taken = add_one(store, one.key, replace(capture, masks=()), blind)
    assert store.detections(one.key) == []
    stop = store.stop(taken.stop_key)
    ys, xs = np.nonzero(true)
    box = (xs.min() - 3.0, ys.min() - 3.0, xs.max() + 3.0, ys.max() + 3.0)
    again = stored_capture(store.images, stop.captures[0], stop)
    key = measurer.add(store, stop, again, measurer.mask_of(again, box=box), OPTIONS)
    detail = store.detection(key)
    assert detail.view.mask is not None
    mask = decode_rle(detail.view.mask, capture.height, capture.width)
    assert (mask & true).sum() / (mask | true).sum() > 0.9
    assert detail.view.length_m is not None
    assert detail.view.along_m is not None
    store.undo(one.key)
    assert store.detections(one.key) == []


@pytest.mark.parametrize("calibrated", [False, True])
def test_a_corrected_outline_has_the_calibration_that_its_depth_has(
    store: Store, measurer: SharedMeasurer, tmp_path: Path, *, calibrated: bool
) -> None:
    capture = next(iter(open_source(example_captures()))).load()
    every_mask = [str(MaskSource.DATASET), str(MaskSource.SAM)]
    house = site(entry(method="M6", mask_sources=every_mask), scale=1.04)
    write_site_calibration(tmp_path / "site.json", house)
    now = replace(OPTIONS, calibration=tmp_path / "site.json")
    before, after = (now, OPTIONS) if calibrated else (OPTIONS, now)
    one = Round(key_of("calibrated"))
    store.save_round(one)
    stop = store.stop(add_one(store, one.key, capture, before).stop_key)
    detail = store.detection(store.detections(one.key)[0].key)
    record = detail.view
    mask = decode_rle(record.mask or "", capture.height, capture.width)
    capture = stored_capture(store.images, detail.capture, detail.stop)
    measurer.correct(store, detail, capture, mask, after)
    corrected = store.detection(detail.view.key).view
    assert calibrated == (record.raw_length is not None) == (corrected.raw_length is not None)
    assert corrected.length_m == pytest.approx(record.length_m, rel=0.01)
    store.set_verdict([detail.view.key], Verdict.REJECTED)
    again = stored_capture(store.images, stop.captures[0], stop)
    added = store.detection(measurer.add(store, stop, again, mask, after)).view
    assert added.length_m == pytest.approx(record.length_m, rel=0.01)


def test_options_and_calibrations_that_change_count_from_the_next_capture_on(
    store: Store, measurer: SharedMeasurer, tmp_path: Path
) -> None:
    capture = next(iter(open_source(example_captures()))).load()
    path = tmp_path / "site.json"
    choices = [replace(OPTIONS, calibration=path)]

    class Queue(WaitingCaptures):
        def done(self, queued_capture: Waiting) -> None:
            super().done(queued_capture)
            if len(self.captures()) == 2:  # another program writes over the file
                write_site_calibration(path, site(scale=1.01))
            elif len(self.captures()) == 1:
                choices[:] = [OPTIONS]

    queue = Queue(tmp_path / "waiting")
    store.save_round(Round(key_of("queue")))
    for number in range(3):
        at = replace(capture, stop=Stop("1", "left", 0.4 * number, number))
        queue.put(at, key_of("press", number), key_of("queue"), float(number + 1))
    write_site_calibration(path, site(scale=1.04))
    assert measure_waiting(queue, measurer, store, lambda: choices[0]) == 3
    stops = sorted(store.stops(key_of("queue")), key=lambda stop: stop.step or 0)
    used = [stored_calibration(store.stop(stop.key)) for stop in stops]
    assert used == [site(scale=1.04), site(scale=1.01), None]
    queue.put(capture, key_of("last"), key_of("queue"), 9.0)
    path.unlink()
    lost = replace(OPTIONS, calibration=path)
    with pytest.raises(errors.CalibrationError, match=r"site\.json: the file is missing"):
        measure_waiting(queue, measurer, store, lambda: lost)
    assert [one.tries for one in queue.captures()] == [0]  # it waits


@pytest.mark.parametrize("kind", [errors.DiskFullError, errors.StoreAwayError])
def test_a_store_that_is_full_or_away_sets_no_capture_aside(
    kind: type[errors.CucumberVisionError],
    store: Store,
    measurer: SharedMeasurer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise kind("database is locked, or its disk full")

    queue = WaitingCaptures(tmp_path / "waiting")
    store.save_round(Round(key_of("queue")))
    capture = next(iter(open_source(example_captures()))).load()
    queue.put(capture, key_of("press"), key_of("queue"), 1.0)
    parts = queue, measurer, store, lambda: OPTIONS
    with monkeypatch.context() as patch:
        patch.setattr(Store, "save_stop", fail)
        for _ in range(4):
            with pytest.raises(kind):
                measure_waiting(*parts)
    assert [one.tries for one in queue.captures()] == [0]
    assert measure_waiting(*parts) == 1


def test_an_outline_that_is_another_fruit_s_is_refused_until_that_one_is_deleted(
    store: Store, measurer: SharedMeasurer
) -> None:
    first, second, *_ = (store.detection(view.key) for view in store.detections(WALK))
    assert first.stop.key == second.stop.key
    mask = decode_rle(second.view.mask or "", second.capture.height_px, second.capture.width_px)
    capture = stored_capture(store.images, first.capture, first.stop)
    with pytest.raises(errors.InstancesError, match=f"that is fruit {second.view.fruit}"):
        measurer.correct(store, first, capture, mask, OPTIONS)
    with pytest.raises(errors.InstancesError, match="there already"):
        measurer.add(store, first.stop, capture, mask, OPTIONS)
    store.set_verdict([second.view.key], Verdict.REJECTED)
    measurer.correct(store, first, capture, mask, OPTIONS)
    now = store.detection(first.view.key).view
    assert now.mask == second.view.mask
    assert not now.keypoints  # they were another outline's


def test_a_correcting_tap_hides_no_end_that_is_in_sight(measurer: SharedMeasurer) -> None:
    for ref in open_source(example_captures()):
        capture = ref.load()
        for own in capture.masks:
            v, u = np.nonzero(own)
            middle = ((u - u.mean()) ** 2 + (v - v.mean()) ** 2).argmin()
            mask = measurer.mask_of(capture, (float(u[middle]), float(v[middle])))
            found, before = (
                measurer.with_options(OPTIONS).measure_instance(
                    capture, Instance(box_of_mask(one), mask=one, mask_source=MaskSource.SAM)
                )
                for one in (mask, own)
            )
            if Flag.END_HIDDEN not in before.flags:
                assert Flag.END_HIDDEN not in found.flags
            assert not is_doubtful(before, capture)


def test_what_does_not_look_like_a_fruit_is_doubtful_until_it_is_accepted(
    store: Store, measurer: SharedMeasurer
) -> None:
    stop = whole_stop(store, store.stops(WALK)[0].key)
    taken = stop.captures[0]
    capture = stored_capture(store.images, taken, stop)
    taken_up = np.zeros((capture.height, capture.width), bool)
    for one in taken.fruit:
        taken_up |= decode_rle(one.mask or "", *taken_up.shape)
    rows, columns = np.indices(taken_up.shape)
    far = cv2.distanceTransform((~taken_up).astype(np.uint8), cv2.DIST_L2, 5)
    far[:60] = far[-60:] = far[:, :60] = far[:, -60:] = 0
    v, u = np.unravel_index(far.argmax(), far.shape)
    leaf = (rows - v) ** 2 + (columns - u) ** 2 < 40**2
    key = measurer.add(store, stop, capture, leaf, OPTIONS)
    view = store.detection(key).view
    assert view.verdict is None
    assert view.doubtful
    assert doubtful([view]) == [view]
    profile = load_profile("long-cucumber")
    seen = store.detections(WALK)
    assert key not in {state.fruit_id for state in fruit_states(seen, 0.0, profile)}
    assert len(hanging_lengths_m(seen)) == 8
    store.set_verdict([key], Verdict.ACCEPTED)
    assert not store.detection(key).view.doubtful
    with pytest.raises(errors.InstancesError, match="most of the picture"):
        measurer.add(store, stop, capture, ~taken_up, OPTIONS)
