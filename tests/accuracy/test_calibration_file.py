from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.accuracy.calibration_file import (
    CalibratedCamera,
    DepthScaleEntry,
    SiteCalibration,
    read_site_calibration,
    write_site_calibration,
)
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CalibrationError, NameRefusedError
from cucumbervision.tube.camera import Distortion

CAMERA = Intrinsics(848, 480, 616.4, 616.4, 424.0, 240.0)
SITE = SiteCalibration(
    name="house-3",
    created="2026-05-02T10:00:00+00:00",
    software="cucumbervision 0",
    camera=CalibratedCamera.of(CAMERA, "841512"),
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
    assert camera.difference(CAMERA, "841512") == ""
    assert camera.difference(CAMERA, None) == ""
    assert camera.difference(CAMERA, "999") == "its camera is 841512, here 999"
    assert camera.difference(replace(CAMERA, fx_px=616.405), None) == ""
    assert "fx 617.400" in camera.difference(replace(CAMERA, fx_px=617.4), None)
    assert camera.difference(replace(CAMERA, width=640), None)
    bent = replace(CAMERA, distortion=Distortion.BROWN_CONRADY, coefficients=(0.1, 0, 0, 0, 0))
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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("escaped", [True, False])
def test_half_of_a_pair_is_no_text_in_any_encoding(
    tmp_path: Path, encoding: str, escaped: bool
) -> None:
    given = json.loads(SITE.as_text())
    given["measured_with"]["models"] = [{"name": "\ud800"}]
    text = json.dumps(given, ensure_ascii=escaped)
    path = tmp_path / "site.json"
    path.write_bytes(text.encode(encoding, errors="surrogatepass"))
    with pytest.raises(CalibrationError, match="is not JSON text"):
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
