"""Captures that are really drawn, measured and saved: then merged over stops and aisles."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CaptureError
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.result import LengthDefinition, MethodName
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.run.measurer import CaptureResult, Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.rounds.adding import (
    Added,
    Place,
    add_captures,
    fruit_record,
    measure_round_again,
    measured_stop,
)
from cucumbervision_greenhouse.rounds.fruit_table import find_round, fruit_table, read_round
from cucumbervision_greenhouse.rounds.merge_and_link import merge_round
from cucumbervision_greenhouse.rounds.walking import PoseLine, pose_matrix
from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.images import ImageStore
from cucumbervision_greenhouse.store.records import FruitRow, Round, StopRecord, Verdict, key_of
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Kind, Scene, render

CAMERA = Intrinsics(424, 240, 308.2, 308.1, 212.1, 119.8)
MORNING = key_of("rounds", "morning")
OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M3, MethodName.M6))
ACROSS_M = 1.4
# Along, up, from the left aisle's cameras; length and radius: metres.
FRUIT = (
    (0.05, 0.02, 0.66, 0.20, 0.020),
    (0.22, -0.03, 0.72, 0.13, 0.017),
    (0.38, 0.04, 0.70, 0.24, 0.022),
    (0.52, -0.02, 0.68, 0.16, 0.018),
    (0.71, 0.01, 0.74, 0.21, 0.021),
)
TRUE = {"left": (0.10, 0.40, 0.70), "right": (0.25, 0.55)}
SAID = {"left": (0.13, 0.38, 0.71), "right": (0.23, 0.57)}


def draw(side: str, number: int, folder: Path) -> Path:
    """Write one capture of the row; masks are the fruit's, left to right in the picture."""
    sign = 1.0 if side == "left" else -1.0
    tubes = []
    for along, up, depth, length, radius in FRUIT:
        away = depth if side == "left" else ACROSS_M - depth
        at = (sign * (along - TRUE[side][number]), -up, away)
        tubes.append(arc_tube(length, radius, 3.0, neck=0.2).moved(rotation(-90.0), at))
    scene = Scene.of(*tubes, backdrop_m=0.95)
    exact = render(scene, CAMERA)
    rng = np.random.default_rng([number, len(side)])
    [depth_m] = sense(scene, D4xx.like(CAMERA), rng, 1)
    color = np.where((exact.kind == Kind.FRUIT)[..., None], [60, 120, 50], [90, 90, 80]).astype(
        np.uint8
    )
    color = np.clip(color + rng.normal(0, 3, color.shape), 0, 255).astype(np.uint8)
    masks = tuple(m for k in range(len(FRUIT)) if (m := exact.mask(k)).sum() > 400)
    place = Stop("3", side, SAID[side][number], number)
    name = f"{side}-{number}"
    capture = Capture(color, depth_m, CAMERA, name, masks=masks, stop=place, simulated=True)
    write_native(capture, folder / name)
    return folder / name


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with all captures of the row."""
    for side, places in TRUE.items():
        for number in range(len(places)):
            draw(side, number, tmp_path / "walk")
    return tmp_path / "walk"


def test_drawn_captures_become_each_fruit_once(store: Store, folder: Path) -> None:
    added = add_captures(store, MORNING, [folder], OPTIONS)
    assert [one.failure for one in added] == [None] * 5
    assert all(one.new for one in added)
    assert merge_round(store, MORNING) == {"3": []}
    table = fruit_table(read_round(store, MORNING))
    assert len(table) == len(FRUIT)
    for line, (along, _, _, length, _) in zip(table, FRUIT, strict=True):
        assert line.along_m == pytest.approx(along, abs=0.03)
        assert line.centreline_m == pytest.approx(length, rel=0.05)
        assert line.views >= 3

    # The same captures again are neither measured nor saved.
    again = add_captures(store, MORNING, [folder], OPTIONS)
    assert [one.stop_key for one in again] == [one.stop_key for one in added]
    assert not any(one.new for one in again)
    assert len(store.stops(MORNING)) == 5


def test_a_deleted_capture_is_told_and_not_measured_again(store: Store, tmp_path: Path) -> None:
    path = draw("left", 0, tmp_path)
    [first] = add_captures(store, MORNING, [path], OPTIONS)
    store.delete_stop(first.stop_key)
    [again] = add_captures(store, MORNING, [path], OPTIONS)
    assert (again.deleted, again.new, again.fruit) == (True, False, 0)
    assert again.stop_key == first.stop_key
    assert store.stops(MORNING) == []


def test_one_bad_input_loses_nothing_of_the_rest(store: Store, tmp_path: Path) -> None:
    good = draw("left", 0, tmp_path)
    seen: list[Added] = []
    nowhere = tmp_path / "nowhere"
    done = add_captures(store, MORNING, [nowhere, good], OPTIONS, report=seen.append)
    assert done[0].failure is not None
    assert "nowhere" in done[0].failure.message
    assert done[1].new
    assert seen == done


def test_place_and_poses_come_before_the_files(store: Store, tmp_path: Path) -> None:
    paths = [draw("left", number, tmp_path) for number in (0, 1)]
    line = PoseLine(capture="left-1", position_m=7.5, position_sd_m=0.01, height_m=1.3)
    place = Place(row="9", position_m=2.0, spacing_m=0.5)
    add_captures(store, MORNING, paths[:1], OPTIONS, place)
    add_captures(store, MORNING, paths[1:], OPTIONS, Place(poses={"left-1": line}))
    first, second = store.stops(MORNING)
    assert (first.row, first.position_m, first.position_sd_m) == ("9", 2.0, 0.03)
    assert (second.row, second.position_m, second.position_sd_m) == ("3", 7.5, 0.01)
    pose = np.array(store.stop(second.key).pose).reshape(4, 4)
    assert pose[:3, 3].tolist() == [7.5, 1.3, 0.0]
    at = [v.along_m for v in store.detections(MORNING) if v.stop_key == second.key]
    # Measured from the camera's true place, 0.40 m.
    expected = [7.5 + along - 0.40 for along, *_ in FRUIT]
    assert sorted(a for a in at if a is not None) == pytest.approx(expected, abs=0.02)


def test_one_camera_takes_a_place_once_and_another_on_its_mast_too(
    store: Store, tmp_path: Path
) -> None:
    first, second, third = (draw("left", number, tmp_path / "low") for number in range(3))
    place = Place(row="9", position_m=2.0, spacing_m=0.5)
    assert add_captures(store, MORNING, [first], OPTIONS, place)[0].new
    slip, next_one = add_captures(store, MORNING, [second, third], OPTIONS, place)
    assert slip.failure is not None
    assert slip.failure.capture == "left-1"
    assert "stop 0 is at 2.00 m of that row and side" in slip.failure.message
    assert next_one.new
    # Of another height, or through another lens, it is another camera's.
    line = PoseLine(capture="left-1", position_m=2.0, height_m=1.3)
    [higher] = add_captures(store, MORNING, [second], OPTIONS, Place("9", poses={"left-1": line}))
    manifest = tmp_path / "low" / "left-1" / "capture.json"
    other = json.loads(manifest.read_text())
    other["name"], other["camera"]["fx"] = "other", other["camera"]["fx"] + 0.7
    manifest.write_text(json.dumps(other))
    [lens] = add_captures(store, MORNING, [second], OPTIONS, place)
    assert (higher.new, lens.new) == (True, True)
    # In the order in which their files were written.
    assert [stop.position_m for stop in store.stops(MORNING)] == [2.0, 2.0, 2.5, 2.0]


def test_a_capture_without_its_pose_is_refused(store: Store, tmp_path: Path) -> None:
    line = PoseLine(capture="another", position_m=1.0)
    path = draw("left", 0, tmp_path)
    [done] = add_captures(store, MORNING, [path], OPTIONS, Place(poses={"another": line}))
    assert done.failure is not None
    assert "left-0: the pose file has no line for this capture" in done.failure.message
    assert store.stops(MORNING) == []


RECORD_OPTIONS = MeasureOptions(instances="dataset")


def stop_of(
    result: CaptureResult,
    measurer: Measurer | None = None,
    images: ImageStore | None = None,
    round_key: str = "r",
) -> StopRecord:
    stop = Place().stop(result.capture, key_of("k"), round_key)
    return measured_stop(stop, [result], measurer, images)


@pytest.fixture(scope="module")
def measured() -> CaptureResult:
    """A bundled capture, measured."""
    refs = {ref.name: ref for ref in open_source(example_captures())}
    capture = refs["simulated-row-a"].load()
    capture = replace(capture, stop=Stop("3", "left", 1.2, 4), timestamp_s=1234.5)
    return Measurer(RECORD_OPTIONS).measure(capture)


def test_a_measured_capture_is_saved_and_comes_back_whole(
    tmp_path: Path, measured: CaptureResult
) -> None:
    walk = Round(name="morning")
    measurer = Measurer(RECORD_OPTIONS)
    networks = ({"name": "sam", "sha256": "ab"},)
    failure = Failure("folder", "b", "CaptureError", str(CaptureError("is empty")))
    with open_store(tmp_path / "house.db") as store:
        store.save_round(walk)
        result = replace(measured, failures=(failure,), models=networks)
        stop = stop_of(result, measurer, store.images, walk.key)
        store.save_stop(stop)
        [taken] = stop.captures
        without = replace(stop, captures=(replace(taken, fruit=()),), fruit=3)
        assert store.stop(stop.key) == without
        found = [(row.cells, row.shape) for row in store.detections(walk.key, shapes=True)]
        assert found == [(row.cells, row.shape) for row in taken.fruit]
        _check_place(store, walk.key)
        saved = store.stop(stop.key).captures[0]
        assert saved.color is not None
        assert saved.depth is not None
        assert saved.thumbnail is not None
        np.testing.assert_array_equal(store.images.read_color(saved.color), measured.capture.color)
        depth = store.images.read_depth(saved.depth)
        np.testing.assert_allclose(depth, measured.capture.depth_m, atol=6e-5)
        assert store.images.read_color(saved.thumbnail).shape[1] == 320
    assert stop.failures[0]["error"] == "CaptureError"
    assert [(a.kind, a.name) for a in stop.artifacts[1:]] == [
        ("config", "measure"),
        ("model", "sam"),
    ]
    assert stop.artifacts[1].sha256 == RECORD_OPTIONS.sha256


def _check_place(store: Store, key: str) -> None:
    [view] = store.stops(key)
    assert (view.row, view.side, view.position_m, view.step) == ("3", "left", 1.2, 4)
    assert (view.position_sd_m, view.taken_s, view.fruit) == (0.03, 1234.5, 3)
    assert len(view.failures) == 1


def test_a_stop_of_a_file_without_a_time_has_the_files_time_whoever_saves_it(
    measured: CaptureResult, tmp_path: Path
) -> None:
    folder = write_native(replace(measured.capture, timestamp_s=None), tmp_path / "a").parent
    os.utime(folder / "capture.json", (1_700_000_000.0, 1_700_000_000.5))
    capture = replace(measured.capture, timestamp_s=None, source=str(folder))
    saved = [stop_of(replace(measured, capture=capture)) for _ in range(2)]
    assert saved[0] == saved[1]
    assert saved[0].taken_s == 1_700_000_000.5
    timed = replace(capture, timestamp_s=1_600_000_000.0)
    assert Place().stop(timed, "k", "r").taken_s == 1_600_000_000.0
    elsewhere = replace(capture, source="s3://bucket/a")
    assert Place().stop(elsewhere, "k", "r").taken_s > 1_700_000_001


def test_a_fruit_lies_where_the_picture_shows_it(measured: CaptureResult) -> None:
    # Of `SCENES`: the middles of the three fruit, camera coordinates.
    drawn = [(-0.17, 0.52), (0.02, 0.55), (0.20, 0.50)]
    [capture] = stop_of(measured).captures
    found = sorted((f.centre_x_m, f.centre_z_m, f.offset_m) for f in capture.fruit if f.centre_x_m)
    for (x, z), (x_m, z_m, offset_m) in zip(drawn, found, strict=True):
        assert x_m == offset_m == pytest.approx(x, abs=0.015)
        assert z_m == pytest.approx(z, abs=0.03)


def test_a_tubes_axis_is_kept_with_a_diameter_at_every_point(measured: CaptureResult) -> None:
    record = fruit_record(measured.capture, 1, measured.fruit[0], pose_matrix(0.0))
    assert len(record.path_m) == len(record.diameter_m) == 48
    along = np.linalg.norm(np.diff(np.array(record.path_m), axis=0), axis=1).sum()
    assert along == pytest.approx(record.centreline_m, rel=0.01)
    assert max(record.diameter_m) == pytest.approx(record.diameter_max_m or 0, rel=0.02)
    # The thinned path still begins and ends where the fruit does.
    fit = measured.fruit[0].measurements[MethodName.M6].fit
    assert fit is not None
    np.testing.assert_allclose(record.path_m[-1], fit.traits.axis_m[-1], atol=1e-6)


def test_a_fruit_that_nothing_measured_is_kept_too(measured: CaptureResult) -> None:
    nothing = measure_fruit(measured.capture, Instance(np.array([0.5, 0.5, 9.5, 9.5])))
    dark = replace(measured.capture, depth_m=np.zeros_like(measured.capture.depth_m))
    nothing = measure_fruit(dark, nothing.instance)
    record = fruit_record(dark, 1, nothing, pose_matrix(0.0))
    assert (record.length_m, record.method, record.view_score) == (None, None, 0.0)
    assert (record.reason, record.mask, record.centre_x_m) == ("no-depth", None, None)
    assert (record.path_m, record.diameter_m) == ((), ())


CHORD = replace(OPTIONS, length=LengthDefinition.CHORD)


def measured_again(store: Store, options: MeasureOptions) -> list[FruitRow]:
    key, failures = measure_round_again(store, find_round(store, MORNING), options)
    assert failures == []
    return store.detections(key)


def test_a_round_is_measured_into_a_new_version_and_the_old_stays_readable(store: Store) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    before = store.detections(MORNING)
    after = measured_again(store, CHORD)
    assert [view.length and str(view.length.kind) for view in after] == ["chord"] * 3
    assert [view.chord_m for view in after] == pytest.approx(
        [view.chord_m for view in before], abs=1e-4
    )
    assert [view.along_m for view in after] == pytest.approx(
        [view.along_m for view in before], abs=1e-3
    )
    [old] = [walk for walk in store.rounds(deleted=True) if walk.key == MORNING]
    [new] = [walk for walk in store.rounds() if walk.key == after[0].round_key]
    assert (new.name, new.walked_s) == (old.name, old.walked_s)
    assert check_store(store).sound
    store.restore_round(MORNING)
    assert store.detections(MORNING) == before


def test_decisions_by_hand_go_with_their_fruit(store: Store) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    accepted, rejected, picked = (view.key for view in store.detections(MORNING))
    store.set_verdict([accepted], Verdict.ACCEPTED)
    store.set_verdict([rejected], Verdict.REJECTED)
    store.pick([picked], at_s=5.0)
    found = [(view.verdict, view.picked_s) for view in measured_again(store, CHORD)]
    assert found == [(Verdict.ACCEPTED, None), (Verdict.REJECTED, None), (None, 5.0)]


def test_a_fruit_that_is_not_found_again_is_measured_in_its_outline(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    before = {round(view.box_x1_px): view for view in store.detections(MORNING)}
    [left, *_] = (before[x] for x in sorted(before))
    store.set_verdict([left.key], Verdict.ACCEPTED)
    find = Measurer.measure_detected

    def without_the_left(measurer: Measurer, *detected: Any) -> CaptureResult:
        result = find(measurer, *detected)
        edges = np.array([fruit.instance.box[0] for fruit in result.fruit])
        kept = [fruit for fruit, x in zip(result.fruit, edges, strict=True) if x > edges.min()]
        return replace(result, fruit=tuple(kept))

    monkeypatch.setattr(Measurer, "measure_detected", without_the_left)
    after = measured_again(store, OPTIONS)
    [again] = [view for view in after if view.verdict is Verdict.ACCEPTED]
    assert (len(after), again.fruit) == (3, 3)
    assert again.length_m == pytest.approx(left.length_m, abs=1e-4)


def test_nothing_changes_where_a_picture_is_missing(store: Store) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    [stop] = store.stops(MORNING)
    depth = store.stop(stop.key).captures[0].depth
    assert depth is not None
    store.images.path(depth).unlink()
    key, [failure] = measure_round_again(store, find_round(store, MORNING), CHORD)
    assert (key, failure.error) == (MORNING, "StoredImageError")
    assert [walk.key for walk in store.rounds() if walk.fruit] == [MORNING]
