from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo_captures import CAMERA

from cucumbervision.about import code_sha256
from cucumbervision.accuracy.calibration_file import (
    CalibratedCamera,
    CorrectionEntry,
    DepthScaleEntry,
    Form,
    IntervalEntry,
    SiteCalibration,
    calibrated_capture,
    calibrated_fruit,
    read_site_calibration,
    write_site_calibration,
)
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision.errors import CalibrationError, NameRefusedError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import (
    Choice,
    Fruit,
    IntervalBasis,
    Length,
    LengthDefinition,
    LengthKind,
    Measurement,
    MethodName,
)

OWN_CAMERA = Intrinsics(848, 480, 616.4, 616.4, 424.0, 240.0)
SITE = SiteCalibration(
    name="house-3",
    created="2026-05-02T10:00:00+00:00",
    software="cucumbervision 0",
    camera=CalibratedCamera.of(OWN_CAMERA, "841512"),
    measured_with={"software": "x", "methods": ["M3"]},
    depth_scale=DepthScaleEntry(
        value=1.01, standard_error=0.001, spread=0.002, captures=4, spacing_m=0.01,
    ),
)  # fmt: skip


def test_a_file_reads_back_the_same_and_keeps_its_tag(tmp_path: Path) -> None:
    path = tmp_path / "new" / "site.json"
    write_site_calibration(path, SITE)
    back = read_site_calibration(path)
    assert back == SITE
    assert back.tag == SITE.tag
    assert back.tag.startswith("house-3@")
    assert back.tag != SITE.model_copy(update={"created": "later"}).tag
    assert back.depth_divisor == 1.01


def test_the_camera_is_told_by_serial_and_intrinsics() -> None:
    camera = SITE.camera
    assert camera.difference(OWN_CAMERA, "841512") == ""
    assert camera.difference(OWN_CAMERA, None) == ""
    assert camera.difference(OWN_CAMERA, "999") == "its camera is 841512, here 999"
    assert camera.difference(replace(OWN_CAMERA, fx_px=616.405), None) == ""
    assert "fx 617.400" in camera.difference(replace(OWN_CAMERA, fx_px=617.4), None)
    assert camera.difference(replace(OWN_CAMERA, width=640), None)
    bent = replace(OWN_CAMERA, distortion=Distortion.BROWN_CONRADY, coefficients=(0.1, 0, 0, 0, 0))
    assert camera.difference(bent, None)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"version": 2}, "is of version 2, this software reads version 1; calibrate again"),
        ({"format": "other"}, "is not a calibration file"),
        ({"depth_scale": {"value": -1}}, "'depth_scale.value'"),
        ({"surprise": 1}, "'surprise': extra inputs"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, change: dict[str, object], text: str) -> None:
    path = tmp_path / "site.json"
    path.write_text(json.dumps({**json.loads(SITE.as_text()), **change}))
    with pytest.raises(CalibrationError, match=text):
        read_site_calibration(path)


def test_what_cannot_be_read_or_written(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="the file is missing; make it with"):
        read_site_calibration(tmp_path / "none.json")
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(CalibrationError, match="is not JSON"):
        read_site_calibration(tmp_path / "a.json")
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_site_calibration(tmp_path / "a.json" / "b.json", SITE)


def test_a_name_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_site_calibration(path, SITE.model_copy(update={"name": "a\u202eb"}))
    with pytest.raises(NameRefusedError, match=r"U\+202E"):
        read_site_calibration(path)


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
        measured_with={"code_sha256": code_sha256()}, depth_scale=depth or None,
        corrections=list(entries),
    )  # fmt: skip


def fruit(
    length_m: float = 0.20,
    method: MethodName = MethodName.M3,
    kind: LengthDefinition | LengthKind = LengthKind.SURFACE_CHORD,
    mask_source: MaskSource | None = MaskSource.DATASET,
    **interval: Any,
) -> Fruit:
    measured = Measurement(method, length_m, LengthKind.SURFACE_CHORD)
    return Fruit(
        Instance(np.array([0.0, 0, 9, 9])), {method: measured}, measured, Choice.DENSE_MASK,
        flags=(Flag.ENDS_UNSURE,), mask_source=mask_source,
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
    assert done.flags == (Flag.ENDS_UNSURE,)
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
    assert done.flags == (Flag.ENDS_UNSURE, flag)
    assert (done.length, done.raw_length, done.calibration) == (before.length, None, None)


@pytest.mark.parametrize("measured_with", [None, {}, {"code_sha256": "0" * 64}])
def test_lengths_of_another_version_correct_nothing(measured_with: dict[str, Any] | None) -> None:
    other = site(entry()).model_copy(update={"measured_with": measured_with})
    done = calibrated_fruit(fruit(), other)
    assert done.flags == (Flag.ENDS_UNSURE, Flag.OTHER_VERSION)
    assert (done.length, done.raw_length, done.calibration) == (fruit().length, None, None)
    # A grid gives depth and lens, of which no length is a part.
    assert not SITE.is_of_other_version


def test_beyond_the_calibrated_lengths_there_is_no_interval() -> None:
    done = calibrated_fruit(fruit(0.34), site(entry()))
    assert done.length is not None
    assert done.length.value_m == pytest.approx(0.384)
    assert done.length.low_m is None
    assert done.flags == (Flag.ENDS_UNSURE, Flag.OUTSIDE_RANGE)
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


@pytest.mark.parametrize(
    "flag", [Flag.END_HIDDEN, Flag.CUT_BY_FRAME, Flag.LOWER_END, Flag.DEPTH_UNALIGNED]
)
def test_fruit_unlike_those_measured_by_hand_keep_their_own_interval(flag: Flag) -> None:
    """18 cm [17, 30] of a fruit that may go on: 1.1 x + 1 cm of each, and not 5 % to both sides."""
    kind = LengthDefinition.CENTRELINE
    simulated: dict[str, Any] = {
        "low_m": 0.17, "high_m": 0.30, "interval_of": kind, "basis": IntervalBasis.SIMULATED,
    }  # fmt: skip
    before = fruit(0.18, MethodName.M6, kind, **simulated)
    chosen = site(entry(method="M6"))
    sound = calibrated_fruit(before, chosen).length
    assert sound is not None
    assert (sound.low_m, sound.high_m) == pytest.approx((0.208 * 0.95, 0.208 * 1.05))
    done = calibrated_fruit(before.flagged(flag), chosen).length
    assert done is not None
    assert (done.value_m, done.low_m, done.high_m) == pytest.approx((0.208, 0.197, 0.340))
    assert done.basis is IntervalBasis.SIMULATED
    as_measured = site(entry(Form.NONE, method="M6"))
    assert calibrated_fruit(before.flagged(flag), as_measured).length == before.length


def test_an_own_interval_takes_the_place_of_one_that_was_too_wide() -> None:
    before = fruit().flagged(Flag.INTERVAL_TOO_WIDE)
    done = calibrated_fruit(before, site(entry()))
    assert done.length is not None
    assert done.length.basis is IntervalBasis.OWN_TRUTH
    assert done.flags == (Flag.ENDS_UNSURE,)


@pytest.mark.parametrize(
    ("kind", "method"), [("thread", "M6 thread"), ("chord", "M6 chord"), ("centreline", "M6")]
)
def test_a_tubes_lengths_have_corrections_of_their_own(kind: str, method: str) -> None:
    definition = LengthDefinition(kind)
    chosen = site(entry(Form.SCALE, method=method, truth_kind=definition, offset_m=0.0))
    done = calibrated_fruit(fruit(method=MethodName.M6, kind=definition), chosen, definition)
    assert done.length is not None
    assert done.length.value_m == pytest.approx(0.22)


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
