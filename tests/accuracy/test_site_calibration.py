from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cucumbervision.accuracy.calibration_file import (
    DepthScaleEntry,
    Form,
    LensEntry,
    corrected,
    write_site_calibration,
)
from cucumbervision.accuracy.own_truth import Measured, evaluate_lengths, read_measured
from cucumbervision.accuracy.site_calibration import (
    calibrate_lengths,
    conformal_half_width,
    fit_correction,
)
from cucumbervision.accuracy.truth import read_truth
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import CalibrationError
from cucumbervision.methods.result import LengthDefinition, MethodName
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render

CAMERA = Intrinsics(640, 360, 460.0, 460.0, 320.0, 180.0)
M3 = MeasureOptions(methods=(MethodName.M3,))


def draw(folder: Path, name: str, length_m: float, spin_deg: float, **more: Any) -> float:
    """Write a capture of one straight tube; return its length."""
    far, tilt = more.get("far_m", 0.5), more.get("tilt_deg", 0.0)
    tube = arc_tube(length_m, more.get("radius_m", 0.018)).moved(
        rotation(0.0, tilt, spin_deg), (0.0, 0.0, far)
    )
    seen = render(Scene.of(tube, backdrop_m=0.7), CAMERA)
    capture = Capture(
        np.full((360, 640, 3), 90, np.uint8),
        (seen.depth_m * more.get("scale", 1.0)).astype(np.float32),
        CAMERA,
        name=name,
        masks=(seen.mask(0),),
        simulated=True,
        provenance={"serial": "841512"},
    )
    write_native(capture, folder / name)
    return tube.centreline_m


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve drawn fruit measured by M3, and a tape that begins 1 cm before each fruit."""
    folder = tmp_path_factory.mktemp("site")
    rng = np.random.default_rng(5)
    lines = ["capture,fruit,specimen,length_1_cm,length_2_cm,kind"]
    for k, length in enumerate(np.linspace(0.10, 0.30, 12)):
        tape = 1 + 100 * draw(folder / "captures", f"c{k:02}", float(length), 90 * rng.random())
        first, second = tape + rng.normal(0, 0.05, 2)
        lines.append(f"c{k:02},1,s{k},{first:.2f},{second:.2f},centreline")
    measure_inputs([folder / "captures"], folder / "run", M3)
    (folder / "truth.csv").write_text("\n".join(lines) + "\n")
    return folder


def changed(run: Path, folder: Path, change: Any) -> Measured:
    report = json.loads((run / "measurements.json").read_text())
    change(report)
    (folder / "measurements.json").write_text(json.dumps(report))
    return read_measured(folder)


def test_a_site_is_calibrated_and_a_new_fruit_comes_out_right(site: Path, tmp_path: Path) -> None:
    made = calibrate_lengths(read_measured(site / "run"), read_truth(site / "truth.csv"), "house")
    entry = made.entry("M3", LengthDefinition.CENTRELINE)
    assert entry is not None
    # What the tape adds does not grow with the length: an offset, not a factor.
    assert entry.form is Form.SCALE_OFFSET
    assert entry.scale == pytest.approx(1.0, abs=0.02)
    assert 0.005 < entry.offset_m < 0.03
    assert (entry.fruit, entry.captures, entry.mask_sources) == (12, 12, ["dataset"])
    assert entry.error_after_percent < 1 < 5 < entry.error_before_percent
    assert entry.interval.half_width is not None
    assert made.camera.serial == "841512"
    assert made.truth is not None
    assert made.truth["floor_mm"] == pytest.approx(0.5, abs=0.25)
    assert made.measured_with is not None
    assert made.measured_with["methods"] == ["M3"]
    assert len(made.measured_with["config_sha256"]) == 64
    write_site_calibration(tmp_path / "house.json", made)
    tape = 1 + 100 * draw(tmp_path / "new", "n", 0.217, 33.0)
    options = replace(M3, calibration=tmp_path / "house.json")
    result = measure_inputs([tmp_path / "new"], tmp_path / "out", options)
    (row,) = result.rows
    assert row["length_cm"] == pytest.approx(tape, rel=0.01)
    assert row["raw_length_cm"] == row["m3_cm"] != row["length_cm"]
    assert row["interval_low_cm"] <= tape <= row["interval_high_cm"]  # type: ignore[operator]
    assert (row["interval_basis"], row["calibration"]) == ("own truth", made.tag)
    report = json.loads((tmp_path / "out" / "measurements.json").read_text())
    assert report["calibration"]["tag"] == made.tag

    def of_other_version(report: dict[str, Any]) -> None:
        report["code_sha256"] = "0" * 64

    older, truth = changed(site / "run", tmp_path, of_other_version), read_truth(site / "truth.csv")
    assert any("Another version" in note for note in evaluate_lengths(older, truth).notes)
    write_site_calibration(tmp_path / "house.json", calibrate_lengths(older, truth, "house"))
    (row,) = measure_inputs([tmp_path / "new"], tmp_path / "out", options).rows
    assert "calibration-other-version" in str(row["flags"]).split()
    assert row["length_cm"] == row["m3_cm"]


def test_captures_of_few_specimens_are_few_fruit(site: Path, tmp_path: Path) -> None:
    text = (site / "truth.csv").read_text()
    for k in range(5, 12):
        text = text.replace(f",s{k},", f",s{k % 5},")
    (tmp_path / "truth.csv").write_text(text)
    truth = read_truth(tmp_path / "truth.csv")
    entry = calibrate_lengths(read_measured(site / "run"), truth, "x").corrections[0]
    assert (entry.form, entry.fruit, entry.captures) == (Form.NONE, 5, 12)
    assert "scale needs 6 fruit, there are 5" in entry.reason
    assert entry.interval.half_width is None
    assert entry.interval.reason == "90 % needs 9 fruit, there are 5"


def test_readings_of_another_method_do_not_count(site: Path, tmp_path: Path) -> None:
    def fall_back(report: dict[str, Any]) -> None:
        for capture in report["captures"][:4]:
            capture["fruit"][0]["methods"]["M3"]["fallback"] = ["M3:too-few-points"]

    measured = changed(site / "run", tmp_path, fall_back)
    (entry,) = calibrate_lengths(measured, read_truth(site / "truth.csv"), "x").corrections
    assert entry.captures == 8


@pytest.mark.parametrize("flag", ["end-hidden", "depth-unaligned"])
def test_what_goes_on_out_of_sight_teaches_no_correction(
    site: Path, tmp_path: Path, flag: str
) -> None:
    """Four fruit of which half was seen, at half of their length, change nothing."""

    def halve(report: dict[str, Any]) -> None:
        for capture in report["captures"][:4]:
            (fruit,) = capture["fruit"]
            fruit["flags"] = f"{fruit['flags']} {flag}".strip()
            fruit["methods"]["M3"]["length_m"] /= 2

    def drop(report: dict[str, Any]) -> None:
        for capture in report["captures"][:4]:
            capture["fruit"][0]["methods"]["M3"]["fallback"] = ["M3:too-few-points"]

    truth = read_truth(site / "truth.csv")
    for folder in ("halved", "dropped"):
        (tmp_path / folder).mkdir()
    halved = changed(site / "run", tmp_path / "halved", halve)
    assert sum(not reading.is_whole for reading in halved.readings) == 4
    dropped = changed(site / "run", tmp_path / "dropped", drop)
    expected = calibrate_lengths(dropped, truth, "x").corrections
    assert calibrate_lengths(halved, truth, "x").corrections == expected
    assert any(
        "4 fruit go on out of sight" in note for note in evaluate_lengths(halved, truth).notes
    )


def test_two_cameras_are_refused(site: Path, tmp_path: Path) -> None:
    def other(report: dict[str, Any]) -> None:
        report["captures"][3]["provenance"]["serial"] = "7"

    with pytest.raises(CalibrationError, match=r"capture 'c03' is of another camera .* here 7"):
        calibrate_lengths(
            changed(site / "run", tmp_path, other), read_truth(site / "truth.csv"), "x"
        )


def test_what_a_run_was_measured_with_is_carried_on(site: Path, tmp_path: Path) -> None:
    scale = DepthScaleEntry(
        value=1.02, standard_error=0.002, spread=0.001, captures=3, spacing_m=0.01
    )
    lens = LensEntry(coefficients=(0.1, -0.2, 0.0, 0.0, 0.0), residual_px=0.5)
    bare = calibrate_lengths(read_measured(site / "run"), read_truth(site / "truth.csv"), "x")

    def calibrated(report: dict[str, Any]) -> None:
        report["calibration"] = {
            "tag": "x@1",
            "depth_scale": scale.model_dump(),
            "lens": lens.model_dump(),
            "camera": bare.camera.model_dump(mode="json"),
        }
        for capture in report["captures"]:
            capture["intrinsics"]["distortion"] = "brown_conrady"
            capture["intrinsics"]["coefficients"] = list(lens.coefficients)

    measured = changed(site / "run", tmp_path, calibrated)
    after = calibrate_lengths(measured, read_truth(site / "truth.csv"), "y")
    assert (after.depth_scale, after.lens, after.camera) == (scale, lens, bare.camera)
    assert after.measured_with is not None
    assert after.measured_with["depth_scale"] == 1.02


TRUTH = np.linspace(0.10, 0.34, 12)
NAMES = [f"f{k}" for k in range(12)]


@settings(deadline=None, max_examples=25)
@given(scale=st.floats(0.7, 1.4), count=st.integers(6, 12))
def test_a_pure_scale_is_recovered_exactly(scale: float, count: int) -> None:
    fit = fit_correction(TRUTH[:count] / scale, TRUTH[:count], NAMES[:count])
    if abs(scale - 1) < 1e-4:  # less than a hundredth of a point to gain
        assert fit.form is Form.NONE
    else:
        assert fit.form is Form.SCALE
        assert fit.scale == pytest.approx(scale, rel=1e-9)
        assert fit.offset_m == 0
        assert fit.error_after_percent < 1e-6
        assert fit.error_before_percent == pytest.approx(100 * abs(1 / scale - 1))


@settings(deadline=None, max_examples=25)
@given(scale=st.floats(0.8, 1.25), offset=st.floats(0.004, 0.03), sign=st.sampled_from([-1, 1]))
def test_scale_and_offset_are_recovered_exactly(scale: float, offset: float, sign: int) -> None:
    fit = fit_correction((TRUTH - sign * offset) / scale, TRUTH, NAMES)
    assert fit.form is Form.SCALE_OFFSET
    assert fit.scale == pytest.approx(scale, rel=1e-6)
    assert fit.offset_m == pytest.approx(sign * offset, rel=1e-6)


@pytest.mark.parametrize(("count", "form"), [(5, Form.NONE), (6, Form.SCALE), (9, Form.SCALE)])
def test_too_few_fruit_are_refused_with_the_least_number(count: int, form: Form) -> None:
    raw = TRUTH[:count] / 1.1 - 0.01
    fit = fit_correction(raw, TRUTH[:count], NAMES[:count])
    assert fit.form is form
    if form is Form.NONE:
        assert "scale needs 6 fruit, there are 5" in fit.reason
        assert (fit.scale, fit.offset_m) == (1.0, 0.0)
    assert f"scale+offset needs 10 fruit, there are {count}" in fit.reason


def test_noise_without_bias_is_seldom_taken_for_a_bias() -> None:
    rng = np.random.default_rng(1)
    taken = 0
    for _ in range(120):
        raw = TRUTH * (1 + rng.normal(0, 0.08, 12))
        taken += fit_correction(raw, TRUTH, NAMES).form is not Form.NONE
    # A gain above one standard error by chance: under 16 %, and leaving out costs besides.
    assert taken / 120 < 0.16


def test_one_gross_error_does_not_drag_the_scale() -> None:
    raw = TRUTH / 1.05
    raw[3] *= 0.4  # the paper's M5 on a fruit that points at the camera
    fit = fit_correction(raw, TRUTH, NAMES)
    assert fit.scale == pytest.approx(1.05, rel=2e-3)


def test_a_fruit_captured_often_counts_once() -> None:
    raw = np.concatenate([TRUTH[:11], np.full(20, TRUTH[11] / 2)])
    truth = np.concatenate([TRUTH[:11], np.full(20, TRUTH[11])])
    fit = fit_correction(raw, truth, NAMES[:11] + [NAMES[11]] * 20)
    # Eleven fruit without error and one with 50 %: 50/12 % on average, weighted by fruit.
    assert fit.error_before_percent == pytest.approx(50 / 12)


def test_held_out_error_by_hand() -> None:
    # Readings of 1/1.1 but for one fruit that reads true. Left out, it is corrected by 1.1: 10 %
    # off; each other is corrected by nearly 1.1, since Huber's weight of the odd one vanishes.
    raw = TRUTH[:9] / 1.1
    raw[0] = TRUTH[0]
    fit = fit_correction(raw, TRUTH[:9], NAMES[:9])
    assert fit.form is Form.SCALE
    assert fit.error_after_percent == pytest.approx(10 / 9, rel=1e-3)
    assert fit.error_before_percent == pytest.approx(100 * 8 / 9 * (1 - 1 / 1.1))
    # Nine fruit at 90 %: the interval needs all nine, so the odd one sets it: 1/1.1 - 1.
    assert fit.interval.half_width == pytest.approx(1 - 1 / 1.1, rel=1e-3)


def test_nothing_or_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="positive"):
        fit_correction([], [], [])
    with pytest.raises(ValueError, match="positive"):
        fit_correction([0.2, -0.1], [0.2, 0.2], ["a", "b"])


def test_conformal_quantile_by_hand() -> None:
    # 19 fruit at 90 %: the 18th smallest of 19, ceil(0.9 x 20) = 18.
    scores = np.arange(1.0, 20.0)
    assert conformal_half_width(scores, [f"{k}" for k in range(19)]) == 18
    # Nine fruit, one with two readings of weight 1/2 each: all of the weight is needed.
    assert conformal_half_width([*range(1, 10), 12.0], [*"abcdefghi", "a"]) == 12
    assert conformal_half_width(np.ones(200), ["a", "b"] * 100) is None
    assert conformal_half_width([*range(8), np.inf], list("abcdefghi")) is None


def test_the_interval_holds_on_new_fruit() -> None:
    rng = np.random.default_rng(7)
    hits = 0
    for _ in range(200):
        truth = rng.uniform(0.1, 0.35, 16)
        raw = truth / 1.06 * (1 + rng.standard_t(4, 16) * 0.02)
        fit = fit_correction(raw[:15], truth[:15], [str(k) for k in range(15)])
        assert fit.interval.half_width is not None
        length = corrected(raw[15], fit.scale, fit.offset_m)
        hits += abs(truth[15] / length - 1) <= fit.interval.half_width
    # ceil(0.9 x 16) = 15 of 15, so 15/16 = 93.75 % is what the theory promises; binomial sd 1.7 %.
    assert 0.90 <= hits / 200 <= 0.985


def test_readings_that_fall_with_the_length_are_not_corrected() -> None:
    fit = fit_correction(0.5 - TRUTH, TRUTH, NAMES)
    assert (fit.form, fit.scale, fit.offset_m) == (Form.NONE, 1.0, 0.0)
    assert fit.reason.endswith("it reads shorter, the longer the fruit is: no correction")
