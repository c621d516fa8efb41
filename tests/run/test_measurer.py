from __future__ import annotations

import errno
import pickle
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from tests.accuracy.test_calibration_file_calibrated import entry, site

from cucumbervision.accuracy.calibration_file import write_site_calibration
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.methods.result import MethodName
from cucumbervision.networks.registry import Registry
from cucumbervision.run.measurer import Boundary, Failure, Measurer, exit_code
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import FolderWorker, OutputFolder, measure_inputs

if TYPE_CHECKING:
    pass


def test_lengths_scale_with_the_depth_through_the_whole_run(tmp_path: Path) -> None:
    path = tmp_path / "site.json"
    write_site_calibration(path, site(scale=1.04))
    captures = [example_captures() / "simulated-bench"]
    options = MeasureOptions(methods=(MethodName.M3,))
    plain = measure_inputs(captures, tmp_path / "a", options).rows
    scaled = measure_inputs(captures, tmp_path / "b", replace(options, calibration=path)).rows
    for before, after in zip(plain, scaled, strict=True):
        assert float(after["length_cm"] or 0) * 1.04 == pytest.approx(
            float(before["length_cm"] or 0), rel=2e-4
        )
        assert str(after["calibration"]).startswith("house@")


def test_another_camera_is_refused_and_the_rest_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "site.json"
    intrinsics = Intrinsics(848, 480, 640.0, 640.0, 424.0, 240.0)
    write_site_calibration(path, site(entry(), camera=intrinsics))
    options = MeasureOptions(methods=(MethodName.M3,), calibration=path)
    result = measure_inputs([example_captures()], tmp_path / "out", options)
    assert (result.rows, len(result.failures)) == ([], 3)
    assert {f.error for f in result.failures} == {"CalibrationError"}
    assert "848x480 fx 640.000 px, here 848x480 fx 616.400 px" in result.failures[0].message


def deciding(measurer: Measurer, out: Path) -> str:
    return FolderWorker(measurer, OutputFolder(out)).deciding


def test_a_run_has_one_calibration_though_its_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "site.json"
    write_site_calibration(path, site(scale=1.04))
    options = MeasureOptions(instances="dataset", methods=(MethodName.M3,), calibration=path)
    calibrated, after = Measurer(options), tmp_path / "after.json"
    assert calibrated.site == site(scale=1.04)
    write_site_calibration(path, site(scale=0.96))
    write_site_calibration(after, site(scale=1.04))
    elsewhere = pickle.loads(pickle.dumps(calibrated))  # what a process of a batch gets
    assert elsewhere.site == calibrated.site
    # Its rows are those of the file that it read: with the new one they are measured again.
    same = deciding(Measurer(replace(options, calibration=after)), tmp_path)
    assert deciding(elsewhere, tmp_path) == deciding(calibrated, tmp_path) == same
    assert deciding(Measurer(options), tmp_path) != same


ERRORS = {
    "OutOfMemoryError": MemoryError(),
    "FileError": OSError(errno.EIO, "Input/output error"),
    "InternalError": OverflowError("cannot convert float infinity to integer"),
}


@pytest.mark.parametrize("code", ERRORS)
def test_whatever_goes_wrong_in_a_capture_is_a_failure_with_a_name(
    code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ERRORS[code]

    capture = next(iter(open_source(example_captures()))).load()
    measurer = Measurer(MeasureOptions(instances="dataset", methods=(MethodName.M1,)))
    monkeypatch.setattr("cucumbervision.run.measurer.measure_fruit", broken)
    result = measurer.attempt(capture)
    assert (result.fruit, [f.error for f in result.failures]) == ((), [code])
    assert str(capture.source) in result.failures[0].message
    assert exit_code(0, result.failures) == (70 if code == "InternalError" else 2)


def test_a_recursion_without_end_is_a_defect_with_its_place() -> None:
    def endless(depth: int) -> int:
        return endless(depth + 1)

    failures: list[Failure] = []
    with Boundary(failures, "house", "a"):
        endless(0)
    assert failures[0].error == "InternalError"
    assert "RecursionError" in failures[0].message
    assert "test_measurer.py, line" in failures[0].message
    assert "report" in failures[0].message


def test_warming_up_loads_the_networks_that_find_fruit(own_registry: Registry) -> None:
    measurer = Measurer(MeasureOptions(segmenter="none"), own_registry)
    assert measurer.models == []
    measurer.warm_up()
    assert measurer.models
    masks = Measurer(MeasureOptions(instances="dataset"), own_registry)
    masks.warm_up()
    assert masks.models == []


@pytest.mark.parametrize(
    ("edge", "upright"), [("top", True), ("bottom", True), ("left", False), ("right", False)]
)
def test_the_edge_that_is_up_says_which_end_is_the_stems(edge: str, upright: bool) -> None:
    mask = np.zeros((480, 480), bool)
    mask[200:220, 100:380] = True
    mask = mask.T if upright else mask
    depth = np.where(mask, 0.5, 0.9).astype(np.float32)
    lens = Intrinsics(480, 480, 600.0, 600.0, 240.0, 240.0)
    capture = Capture(np.zeros((480, 480, 3), np.uint8), depth, lens, "bar", masks=(mask,))
    options = MeasureOptions(instances="dataset", segmenter="none", camera_up=edge)
    (fruit,) = Measurer(options).measure(capture).fruit
    assert fruit.pose is not None
    across, down = lens.project(fruit.pose.stem_m[None])[0]
    far = {"top": down, "bottom": 479 - down, "left": across, "right": 479 - across}[edge]
    assert far == pytest.approx(100, abs=8)
    assert fruit.pose.stem_confidence > 0.99
    # What the capture says itself comes first.
    lies = replace(capture, gravity=(0.0, 0.0, 1.0))
    (fruit,) = Measurer(options).measure(lies).fruit
    assert fruit.pose is not None
    assert fruit.pose.stem_confidence == pytest.approx(0.5, abs=0.1)


def test_ends_are_looked_at_where_that_is_asked_for_and_networks_drew_the_masks() -> None:
    capture = next(iter(open_source(example_captures()))).load()
    options = MeasureOptions(instances="models", methods=(MethodName.M6,))
    before = Measurer(replace(options, end_look=False)).measure(capture)
    after = Measurer(options).measure(capture)
    assert "cucumber-look" not in {model["name"] for model in before.models}
    assert "cucumber-look" in {model["name"] for model in after.models}
    assert len(before.fruit) == len(after.fruit) > 0
    for old, new in zip(before.fruit, after.fruit, strict=True):
        assert old.fit is not None
        assert new.fit is not None
        assert old.fit.looks is None
        assert new.fit.looks is not None
        assert old.length is not None
        assert new.length is not None
        assert new.length.value_m == old.length.value_m
        assert new.length.low_m is not None
        assert new.length.high_m is not None
        assert new.length.low_m <= new.length.value_m <= new.length.high_m
    measurer = Measurer(replace(options, instances="dataset", end_look=True))
    given = measurer.measure(capture)
    assert measurer.models == []
    assert all(fruit.fit is not None and fruit.fit.looks is None for fruit in given.fruit)
