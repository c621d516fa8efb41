"""Settings and serial numbers against the SDK's own software device."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cucumbervision.capture.realsense import CameraSettings, apply_settings, list_cameras
from cucumbervision.errors import CameraError

rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)


def limits(low: float, high: float, step: float, default: float) -> Any:
    given = rs.option_range()
    given.min, given.max, given.step, given.default = low, high, step, default
    return given


@pytest.fixture
def device() -> Any:
    made = rs.software_device()
    made.register_info(rs.camera_info.name, "Software D435")
    made.register_info(rs.camera_info.serial_number, "0042")
    depth, color = made.add_sensor("Stereo Module"), made.add_sensor("RGB Camera")
    depth.add_option(rs.option.visual_preset, limits(0, 5, 1, 1), True)
    color.add_option(rs.option.enable_auto_exposure, limits(0, 1, 1, 1), True)
    color.add_option(rs.option.exposure, limits(1, 10000, 1, 156), True)
    return made


def values(device: Any) -> dict[tuple[str, str], float]:
    return {
        (sensor.get_info(rs.camera_info.name), option.name): (sensor.get_option(option))
        for sensor in device.query_sensors()
        for option in sensor.get_supported_options()
    }


def test_settings_reach_their_sensors(device: Any) -> None:
    settings = CameraSettings("high-accuracy", exposure_us=8000)
    apply_settings(rs, device, settings, "camera 0042")
    found = values(device)
    assert found["Stereo Module", "visual_preset"] == 3  # RS2_RS400_VISUAL_PRESET_HIGH_ACCURACY
    assert found["RGB Camera", "exposure"] == 80  # in the SDK's hundreds of microseconds
    assert found["RGB Camera", "enable_auto_exposure"] == 0
    apply_settings(rs, device, CameraSettings(exposure_us=0), "camera 0042")
    assert values(device) == found | {("RGB Camera", "enable_auto_exposure"): 1.0}


def test_what_is_not_asked_for_stays(device: Any) -> None:
    before = values(device)
    apply_settings(rs, device, CameraSettings(), "camera")
    assert values(device) == before


def test_a_sensor_that_is_not_there_is_said() -> None:
    bare = rs.software_device()
    bare.register_info(rs.camera_info.name, "Software D435")
    with pytest.raises(CameraError, match="auto exposure cannot be set"):
        apply_settings(rs, bare, CameraSettings(exposure_us=8000), "camera")


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            CameraSettings(exposure_us=1e7),
            "rgb camera's exposure cannot be 100000; give 1 to 10000",
        ),
        (CameraSettings(preset="sharp"), "no preset is called 'sharp'; choose one of .*hand"),
    ],
)
def test_what_the_camera_cannot_is_said(device: Any, settings: CameraSettings, text: str) -> None:
    with pytest.raises(CameraError, match=text):
        apply_settings(rs, device, settings, "camera")


def test_cameras_are_listed_by_serial_number(recording: Path) -> None:
    context = rs.context()
    assert "0042" not in [camera.serial for camera in list_cameras(context)]
    # A recording that is loaded into a context is one of its devices.
    played = context.load_device(str(recording))
    found = [camera for camera in list_cameras(context) if camera.serial == "0042"]
    assert [(one.name, one.firmware) for one in found] == [("Software D435", "")]
    played.pause()
