from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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
from cucumbervision.capture.bundled import bundled_captures
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CalibrationError
from cucumbervision.measurement.result import Length, Method
from cucumbervision.pipeline.calibrated import calibrated_capture, calibrated_row
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.rows import COLUMNS
from cucumbervision.pipeline.run import measure_inputs
from cucumbervision_lab.synthesis.demo import CAMERA


def entry(
    form: Form = Form.SCALE_OFFSET, half: float | None = 0.05, **changes: Any
) -> CorrectionEntry:
    values: dict[str, Any] = {
        "method": "M3", "truth_kind": Length.THREAD, "form": form, "scale": 1.1,
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
        value=scale, standard_error=0.001, spread=0.0, captures=3, method="M3",
        reference_length_m=0.5,
    )  # fmt: skip
    return SiteCalibration(
        name="house", created="", software="", camera=CalibratedCamera.of(camera, "841"),
        measured_with=MeasuredWith(
            software="", config_sha256="", selector="best", methods=[], instances="auto"
        ),
        depth_scale=depth or None, corrections=list(entries),
    )  # fmt: skip


def row(**changes: Any) -> dict[str, Any]:
    cells: dict[str, Any] = {column.name: None for column in COLUMNS}
    cells.update(
        method="M3", length_cm=20.0, length_kind="surface-chord", mask_source="dataset",
        flags="cut-by-frame", m3_cm=20.0,
    )  # fmt: skip
    return {**cells, **changes}


def test_a_row_is_corrected_and_says_so() -> None:
    chosen = site(entry())
    done = calibrated_row(row(), chosen)
    # 1.1 x 20 + 1 = 23; 5 % to both sides.
    assert done["length_cm"] == pytest.approx(23)
    assert (done["raw_length_cm"], done["raw_length_kind"]) == (20.0, "surface-chord")
    assert done["length_kind"] == "thread"
    assert done["interval_low_cm"] == pytest.approx(21.85)
    assert done["interval_high_cm"] == pytest.approx(24.15)
    assert done["interval_basis"] == "own truth"
    assert done["calibration"] == chosen.tag
    assert (done["m3_cm"], done["flags"]) == (20.0, "cut-by-frame")
    assert list(done) == [column.name for column in COLUMNS]


@pytest.mark.parametrize(
    ("changes", "length", "flag"),
    [
        ({"method": "M5"}, Length.THREAD, "calibration-not-covered"),
        ({}, Length.CHORD, "calibration-not-covered"),
        ({"mask_source": "sam"}, Length.THREAD, "calibration-other-mask"),
        ({"mask_source": None}, Length.THREAD, "calibration-other-mask"),
    ],
)
def test_what_it_does_not_cover_stays_and_is_flagged(
    changes: dict[str, Any], length: Length, flag: str
) -> None:
    before = row(**changes)
    done = calibrated_row(before, site(entry()), length)
    assert done == {**before, "flags": f"cut-by-frame {flag}"}


def test_beyond_the_calibrated_lengths_there_is_no_interval() -> None:
    done = calibrated_row(row(length_cm=34.0), site(entry()))
    assert done["length_cm"] == pytest.approx(38.4)
    assert done["interval_low_cm"] is None
    assert done["flags"] == "cut-by-frame outside-calibrated-range"
    nothing = calibrated_row(row(length_cm=8.0), site(entry(offset_m=-0.1)))
    assert (nothing["length_cm"], nothing["calibration"]) == (8.0, None)
    assert "outside-calibrated-range" in str(nothing["flags"])


def test_an_interval_from_elsewhere_does_not_outlive_a_correction() -> None:
    before = row(interval_low_cm=19.0, interval_high_cm=21.0, interval_basis="simulated")
    moved = calibrated_row(before, site(entry(half=None)))
    assert (moved["interval_low_cm"], moved["interval_basis"]) == (None, None)
    stayed = calibrated_row(before, site(entry(Form.NONE, half=None)))
    assert (stayed["interval_low_cm"], stayed["interval_basis"]) == (19.0, "simulated")
    own = calibrated_row(before, site(entry()))
    assert own["interval_high_cm"] == pytest.approx(24.15)
    assert own["interval_basis"] == "own truth"


def test_no_correction_but_an_interval() -> None:
    done = calibrated_row(row(), site(entry(Form.NONE)))
    assert (done["length_cm"], done["length_kind"]) == (20.0, "thread")
    assert (done["interval_low_cm"], done["interval_high_cm"]) == (19.0, 21.0)
    bare = calibrated_row(row(), site(entry(Form.NONE, half=None)))
    assert (bare["length_cm"], bare["length_kind"]) == (20.0, "surface-chord")
    assert bare["interval_basis"] is None
    assert bare["calibration"]


@pytest.mark.parametrize(
    ("kind", "method"), [("thread", "M6 thread"), ("chord", "M6 chord"), ("centreline", "M6")]
)
def test_a_tubes_lengths_have_corrections_of_their_own(kind: str, method: str) -> None:
    chosen = site(entry(Form.SCALE, method=method, truth_kind=Length(kind), offset_m=0.0))
    done = calibrated_row(row(method="M6", length_kind=kind), chosen, Length(kind))
    assert done["length_cm"] == pytest.approx(22)


def test_a_fruit_that_was_not_measured_stays_so() -> None:
    nothing = row(method=None, length_cm=None, length_kind=None)
    assert calibrated_row(nothing, site(entry())) == nothing
    scaled = site(scale=1.02)
    assert calibrated_row(nothing, scaled)["calibration"] == scaled.tag


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
    captures = [bundled_captures() / "simulated-bench"]
    options = MeasureOptions(methods=(Method.M3,))
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
    options = MeasureOptions(methods=(Method.M3,), calibration=path)
    result = measure_inputs([bundled_captures()], tmp_path / "out", options)
    assert (result.rows, len(result.failures)) == ([], 3)
    assert {f.error for f in result.failures} == {"CalibrationError"}
    assert "848x480 fx 640.000 px, here 848x480 fx 616.400 px" in result.failures[0].message
