from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo_captures import CAMERA

from cucumbervision.calibration.calibration_file import (
    CalibratedCamera,
    CorrectionEntry,
    DepthScaleEntry,
    IntervalEntry,
    MeasuredWith,
    SiteCalibration,
    write_site_calibration,
)
from cucumbervision.calibration.corrections import Form
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CalibrationError, DiskFullError
from cucumbervision.instances.instance import Instance, MaskSource
from cucumbervision.measurement.flags import Flag
from cucumbervision.measurement.result import (
    Choice,
    FruitMeasurement,
    IntervalBasis,
    Length,
    LengthDefinition,
    LengthKind,
    Measurement,
    MethodName,
)
from cucumbervision.perception.registry import Registry
from cucumbervision.pipeline.measurer import (
    Boundary,
    Failure,
    Measurer,
    calibrated_capture,
    calibrated_fruit,
    exit_code,
)
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.run import measure_inputs
from cucumbervision.pipeline.stages import Stage


def entry(
    form: Form = Form.SCALE_OFFSET, half: float | None = 0.05, **changes: Any
) -> CorrectionEntry:
    values: dict[str, Any] = {
        "method": "M3", "truth_kind": LengthDefinition.CENTRELINE, "form": form, "scale": 1.1,
        "offset_m": 0.01, "reason": "", "fruit": 12, "captures": 12, "error_before_percent": 9.0,
        "error_after_percent": 2.0, "residual_sd_percent": 2.0, "raw_range_m": (0.10, 0.30),
        "mask_sources": ["dataset"],
        "interval": IntervalEntry(level=0.9, half_width=half, reason=""),
    }  # fmt: skip
    if form is Form.NONE:
        values.update(scale=1.0, offset_m=0.0)
    return CorrectionEntry(**{**values, **changes})


def site(*entries: CorrectionEntry, scale: float | None = None, camera: Any = CAMERA) -> Any:
    depth = scale and DepthScaleEntry(
        value=scale, standard_error=0.001, spread=0.0, captures=3, spacing_m=0.01,
    )  # fmt: skip
    return SiteCalibration(
        name="house", created="", software="", camera=CalibratedCamera.of(camera, "841"),
        measured_with=MeasuredWith(
            software="", config_sha256="", selector="best", methods=[], instances="auto"
        ),
        depth_scale=depth or None, corrections=list(entries),
    )  # fmt: skip


def fruit(
    length_m: float = 0.20,
    method: MethodName = MethodName.M3,
    kind: LengthDefinition | LengthKind = LengthKind.SURFACE_CHORD,
    mask_source: MaskSource | None = MaskSource.DATASET,
    **interval: Any,
) -> FruitMeasurement:
    measured = Measurement(method, length_m, LengthKind.SURFACE_CHORD)
    return FruitMeasurement(
        Instance(np.array([0.0, 0, 9, 9])), {method: measured}, measured, Choice.DENSE_MASK,
        flags=(Flag.CUT_BY_FRAME,), mask_source=mask_source,
        length=Length(length_m, kind, **interval),
    )  # fmt: skip


def test_a_fruit_is_corrected_and_says_so() -> None:
    chosen = site(entry())
    done = calibrated_fruit(fruit(), chosen)
    # 1.1 x 20 + 1 = 23; 5 % to both sides.
    assert done.raw_length == Length(0.20, LengthKind.SURFACE_CHORD)
    assert done.length is not None
    assert done.length.value_m == pytest.approx(0.23)
    assert (done.length.low_m, done.length.high_m) == pytest.approx((0.2185, 0.2415))
    assert done.length.kind is done.length.interval_of is LengthDefinition.CENTRELINE
    assert done.length.basis is IntervalBasis.OWN_TRUTH
    assert done.calibration == chosen.tag
    assert done.flags == (Flag.CUT_BY_FRAME,)
    assert done.measurements[MethodName.M3].length_m == 0.20


@pytest.mark.parametrize(
    ("changes", "definition", "flag"),
    [
        ({"method": MethodName.M5}, LengthDefinition.CENTRELINE, Flag.NOT_COVERED),
        ({}, LengthDefinition.CHORD, Flag.NOT_COVERED),
        ({"mask_source": MaskSource.SAM}, LengthDefinition.CENTRELINE, Flag.OTHER_MASK),
        ({"mask_source": None}, LengthDefinition.CENTRELINE, Flag.OTHER_MASK),
    ],
)
def test_what_it_does_not_cover_stays_and_is_flagged(
    changes: dict[str, Any], definition: LengthDefinition, flag: Flag
) -> None:
    before = fruit(**changes)
    done = calibrated_fruit(before, site(entry()), definition)
    assert done.flags == (Flag.CUT_BY_FRAME, flag)
    assert (done.length, done.raw_length, done.calibration) == (before.length, None, None)


def test_beyond_the_calibrated_lengths_there_is_no_interval() -> None:
    done = calibrated_fruit(fruit(0.34), site(entry()))
    assert done.length is not None
    assert done.length.value_m == pytest.approx(0.384)
    assert done.length.low_m is None
    assert done.flags == (Flag.CUT_BY_FRAME, Flag.OUTSIDE_RANGE)
    nothing = calibrated_fruit(fruit(0.08), site(entry(offset_m=-0.1)))
    assert nothing.length == Length(0.08, LengthKind.SURFACE_CHORD)
    assert nothing.calibration is None
    assert Flag.OUTSIDE_RANGE in nothing.flags


def test_an_interval_from_elsewhere_does_not_outlive_a_correction() -> None:
    before = fruit(low_m=0.19, high_m=0.21, basis=IntervalBasis.SIMULATED)
    moved = calibrated_fruit(before, site(entry(half=None))).length
    assert moved is not None
    assert (moved.low_m, moved.basis) == (None, None)
    assert calibrated_fruit(before, site(entry(Form.NONE, half=None))).length == before.length
    own = calibrated_fruit(before, site(entry())).length
    assert own is not None
    assert own.high_m == pytest.approx(0.2415)
    assert own.basis is IntervalBasis.OWN_TRUTH


def test_no_correction_but_an_interval() -> None:
    done = calibrated_fruit(fruit(), site(entry(Form.NONE))).length
    assert done is not None
    assert (done.value_m, done.low_m, done.high_m) == pytest.approx((0.20, 0.19, 0.21))
    assert done.kind is LengthDefinition.CENTRELINE
    bare = calibrated_fruit(fruit(), site(entry(Form.NONE, half=None)))
    assert bare.length == Length(0.20, LengthKind.SURFACE_CHORD)
    assert bare.calibration


@pytest.mark.parametrize(
    ("kind", "method"), [("thread", "M6 thread"), ("chord", "M6 chord"), ("centreline", "M6")]
)
def test_a_tubes_lengths_have_corrections_of_their_own(kind: str, method: str) -> None:
    definition = LengthDefinition(kind)
    chosen = site(entry(Form.SCALE, method=method, truth_kind=definition, offset_m=0.0))
    done = calibrated_fruit(fruit(method=MethodName.M6, kind=definition), chosen, definition)
    assert done.length is not None
    assert done.length.value_m == pytest.approx(0.22)


def test_a_fruit_that_was_not_measured_stays_so() -> None:
    nothing = replace(fruit(), selected=None, length=None)
    assert calibrated_fruit(nothing, site(entry())) is nothing
    scaled = site(scale=1.02)
    assert calibrated_fruit(nothing, scaled).calibration == scaled.tag


def test_depth_is_divided_by_the_scale() -> None:
    depth = np.full((480, 848), 0.51, np.float32)
    depth[0, 0] = 0
    capture = Capture(np.zeros((480, 848, 3), np.uint8), depth, CAMERA, "a")
    done = calibrated_capture(capture, site(scale=1.02))
    assert done.depth_m.dtype == np.float32
    assert done.depth_m[1, 1] == pytest.approx(0.5)
    assert done.depth_m[0, 0] == 0
    assert calibrated_capture(capture, site()) is capture
    with pytest.raises(CalibrationError, match="its camera is 841, here 7; calibrate"):
        calibrated_capture(replace(capture, provenance={"serial": "7"}), site())


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
    other = Intrinsics(848, 480, 640.0, 640.0, 424.0, 240.0)
    write_site_calibration(path, site(entry(), camera=other))
    options = MeasureOptions(methods=(MethodName.M3,), calibration=path)
    result = measure_inputs([example_captures()], tmp_path / "out", options)
    assert (result.rows, len(result.failures)) == ([], 3)
    assert {f.error for f in result.failures} == {"CalibrationError"}
    assert "848x480 fx 640.000 px, here 848x480 fx 616.400 px" in result.failures[0].message


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
    monkeypatch.setattr("cucumbervision.pipeline.measurer.measure_fruit", broken)
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


def test_a_full_disk_passes_the_boundary_by_its_name() -> None:
    failures: list[Failure] = []
    with pytest.raises(DiskFullError, match="free some space"), Boundary(failures, "house"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert failures == []


def test_an_interruption_passes_the_boundary() -> None:
    with pytest.raises(KeyboardInterrupt), Boundary([], "house"):
        raise KeyboardInterrupt


def test_exit_codes() -> None:
    bad, defect = (Failure("a", "", error, "") for error in ("CaptureError", "InternalError"))
    assert [exit_code(*x) for x in ((2, []), (2, [bad]), (0, [bad]), (2, [bad, defect]))] == [
        0, 1, 2, 70,
    ]  # fmt: skip


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
    (found,) = Measurer(options).measure(capture).fruit
    assert found.pose is not None
    across, down = lens.project(found.pose.stem_m[None])[0]
    far = {"top": down, "bottom": 479 - down, "left": across, "right": 479 - across}[edge]
    assert far == pytest.approx(100, abs=8)
    assert found.pose.stem_confidence > 0.99
    # What the capture says itself comes first.
    lies = replace(capture, gravity=(0.0, 0.0, 1.0))
    (found,) = Measurer(options).measure(lies).fruit
    assert found.pose is not None
    assert found.pose.stem_confidence == pytest.approx(0.5, abs=0.1)


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
    assert all(one.fit is not None and one.fit.looks is None for one in given.fruit)


def test_what_rows_depend_on_knows_the_look() -> None:
    options = MeasureOptions(instances="models")
    hashes = [
        Measurer(replace(options, end_look=look)).hashes.of([Stage.DETECTED, Stage.KEPT])
        for look in (False, True)
    ]
    assert hashes[0] != hashes[1]
