from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CaptureError
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.result import MethodName
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.run.measurer import CaptureResult, Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.rounds.adding import Place, fruit_record, measured_stop
from cucumbervision_greenhouse.rounds.poses import pose_matrix
from cucumbervision_greenhouse.store.images import ImageStore
from cucumbervision_greenhouse.store.records import Round, StopRecord, key_of
from cucumbervision_greenhouse.store.repository import Store, open_store

OPTIONS = MeasureOptions(instances="dataset")


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
    return Measurer(OPTIONS).measure(capture)


def test_a_measured_capture_is_saved_and_comes_back_whole(
    tmp_path: Path, measured: CaptureResult
) -> None:
    walk = Round(name="morning")
    measurer = Measurer(OPTIONS)
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
    assert stop.artifacts[1].sha256 == OPTIONS.sha256


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
