from __future__ import annotations

import errno
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.accuracy.test_calibration_file import entry, site

from cucumbervision.accuracy.calibration_file import write_site_calibration
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.crop.profiles import load_profile
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import (
    Choice,
    Fruit,
    Length,
    LengthKind,
    Measurement,
    MethodName,
    Reason,
)
from cucumbervision.networks.registry import Registry
from cucumbervision.run.measurer import (
    Boundary,
    Failure,
    Measurer,
    accepted_fruit,
    exit_code,
    with_unit_doubts,
)
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import FolderWorker, OutputFolder, measure_inputs


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


LENGTHS_M, DIAMETERS_M = (0.05, 0.80), (0.012, 0.07)


def scaled(factor: float, name: str = "simulated-row-a") -> Capture:
    """A bundled capture whose depth is read in steps that many times as large."""
    capture = next(iter(open_source(example_captures() / name).refs())).load()
    far = capture.depth_m * np.float32(factor)
    return replace(capture, depth_m=np.where(far < 5, far, 0).astype(np.float32))


def test_a_cucumber_of_74_cm_is_too_thick_and_says_so() -> None:
    # The third is 14.9 cm long and 3.3 cm thick: in steps of 0.2 mm read as 1 mm, 74 and 16.
    options = MeasureOptions(instances="dataset")
    wide = replace(options, accepted_m=(0.0, 9.0), accepted_diameter_m=(0.0, 9.0))
    length = Measurer(wide).measure(scaled(5)).fruit[2].length
    assert length is not None
    assert length.value_m == pytest.approx(0.74, abs=0.01)
    fruit = Measurer(options).measure(scaled(5)).fruit
    assert [one.length for one in fruit] == [None, None, None]
    assert str(fruit[2].reason) == "implausible-diameter"
    assert fruit[2].fallback[-1] == "M6:out-of-range"
    assert all(Flag.DEPTH_UNIT in one.flags for one in fruit)


def raw(length_m: float, width_m: float, reason: Reason) -> tuple[Fruit, Capture]:
    """A fruit that M5 measured, M6's tube having failed, on a bar 1 m away: 1 px is 2 mm."""
    capture = scaled(1)
    pixels = round(length_m * width_m / 0.002**2)
    mask = np.zeros(capture.depth_m.shape, bool)
    mask.flat[:pixels] = True
    camera = replace(capture.intrinsics, fx_px=500.0, fy_px=500.0)
    five = Measurement(MethodName.M5, length_m, LengthKind.SURFACE_ARC)
    six = Measurement(MethodName.M6, reason=reason)
    fruit = Fruit(
        Instance(np.array([0.0, 0, 9, 9])), {MethodName.M5: five, MethodName.M6: six}, five,
        Choice.DENSE_MASK, mask=mask, length=Length(length_m, LengthKind.SURFACE_ARC),
        distance_m=1.0,
    )  # fmt: skip
    return fruit, replace(capture, intrinsics=camera)


@pytest.mark.parametrize(
    ("length_m", "width_m", "reason", "said", "large"),
    [
        (0.60, 0.065, Reason.OUT_OF_RANGE, Choice.DENSE_MASK, False),
        (0.60, 0.075, Reason.OUT_OF_RANGE, Choice.IMPLAUSIBLE_DIAMETER, True),
        # A mask's width counts only where it is as good as a tube.
        (0.60, 0.075, Reason.TOO_FEW_POINTS, Choice.DENSE_MASK, False),
        (0.30, 0.010, Reason.OUT_OF_RANGE, Choice.IMPLAUSIBLE_DIAMETER, False),
        (0.90, 0.040, Reason.NOT_A_TUBE, Choice.IMPLAUSIBLE, True),
        (0.04, 0.040, Reason.NOT_A_TUBE, Choice.IMPLAUSIBLE, False),
    ],
)
def test_what_is_refused(
    length_m: float, width_m: float, reason: Reason, said: Choice, large: bool
) -> None:
    fruit, capture = raw(length_m, width_m, reason)
    done = accepted_fruit(fruit, LENGTHS_M, DIAMETERS_M, capture.intrinsics)
    assert done.reason is said
    assert (done.length is None) == (done.selected is None) == (said is not Choice.DENSE_MASK)
    assert (Flag.DEPTH_UNIT in done.flags) == large


def test_half_a_picture_that_is_too_large_casts_doubt_on_the_rest() -> None:
    fruit, capture = raw(0.30, 0.04, Reason.NOT_A_TUBE)
    large = accepted_fruit(fruit, LENGTHS_M, (0.0, 0.01), capture.intrinsics)
    assert large.length is not None  # no tube: nothing is known of its diameter
    large = accepted_fruit(fruit, (0.0, 0.20), DIAMETERS_M, capture.intrinsics)
    unmeasured = replace(fruit, length=None, reason=Choice.NO_DEPTH)
    doubted = with_unit_doubts([large, fruit, unmeasured])
    assert [Flag.DEPTH_UNIT in one.flags for one in doubted] == [True, True, False]
    assert doubted[1].length is not None
    assert with_unit_doubts([large, fruit, fruit]) == (large, fruit, fruit)
    assert with_unit_doubts([]) == ()


@pytest.mark.parametrize("name", ["aubergine", "courgette", "green-bean", "long-cucumber"])
def test_a_crop_five_times_as_large_is_none(name: str) -> None:
    usual_cm = {"aubergine": 6.0, "courgette": 4.5, "green-bean": 0.9, "long-cucumber": 4.5}[name]
    least, most = load_profile(name).accepted_diameter_m
    assert least < usual_cm / 100 < most < 5 * usual_cm / 100
