from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.accuracy.calibration_file import (
    DepthScaleEntry,
    Form,
    LensEntry,
    write_site_calibration,
)
from cucumbervision.accuracy.own_truth import Measured, evaluate_lengths, read_measured
from cucumbervision.accuracy.site_calibration import calibrate_lengths
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


def test_without_a_camera_there_is_no_calibration(site: Path, tmp_path: Path) -> None:
    table = tmp_path / "measurements.csv"
    table.write_bytes((site / "run" / "measurements.csv").read_bytes())
    with pytest.raises(CalibrationError, match="does not say which camera"):
        calibrate_lengths(read_measured(table), read_truth(site / "truth.csv"), "x")


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
