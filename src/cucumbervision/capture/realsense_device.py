"""RealSense devices: importing the SDK, listing cameras, and camera settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cucumbervision.errors import CameraError, MissingExtraError


def import_realsense() -> Any:
    """Import pyrealsense2.

    Raises
    ------
    MissingExtraError
        If the package is not installed.
    CameraError
        If libusb is missing.
    """
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise MissingExtraError("pyrealsense2", "camera") from None
    except ImportError as error:
        raise CameraError(
            "pyrealsense2 cannot be loaded ({reason})",
            remedy="install the system package libusb-1.0-0 (libusb1 on Fedora)",
            reason=error,
        ) from None
    return pyrealsense2


def camera_fault(error: RuntimeError, source: object) -> CameraError:
    """Convert an error of the SDK."""
    text = str(error)
    if "No device" in text:
        return CameraError(
            "no RealSense camera is connected",
            source=source,
            remedy="plug a D4xx into a USB 3 port, or name a recording",
        )
    if "resolve" in text:
        return CameraError(
            "no connected camera streams that size and rate",
            source=source,
            remedy="choose a size and rate of the camera, and check that it is at a USB 3 port",
        )
    if "busy" in text.lower():
        return CameraError(
            "the camera is in use", source=source, remedy="close the other program that uses it"
        )
    return CameraError(
        "the camera failed ({reason})", source=source, remedy="plug it in again", reason=text
    )


@dataclass(frozen=True)
class FoundCamera:
    """A connected camera.

    Parameters
    ----------
    name, serial, firmware, usb : str
        Values from the SDK; empty if unknown. `usb` is '3.2' for a USB 3 port.
    """

    name: str
    serial: str
    firmware: str
    usb: str


def list_cameras(context: Any = None) -> list[FoundCamera]:
    """Return the connected RealSense cameras.

    Parameters
    ----------
    context : pyrealsense2.context, optional
        SDK context; by default a new one.

    Raises
    ------
    MissingExtraError
        If pyrealsense2 is not installed.
    CameraError
        If the SDK fails.
    """
    rs = import_realsense()
    info = rs.camera_info
    kinds = (info.name, info.serial_number, info.firmware_version, info.usb_type_descriptor)
    try:
        devices = list((context or rs.context()).query_devices())
        return [
            FoundCamera(*(d.get_info(kind) if d.supports(kind) else "" for kind in kinds))
            for d in devices
        ]
    except RuntimeError as error:
        raise camera_fault(error, "cameras") from None


@dataclass(frozen=True)
class CameraSettings:
    """Exposure and preset of a camera; None keeps the current setting.

    Parameters
    ----------
    preset : str, optional
        Name of the depth preset in the SDK: 'high_accuracy', 'high_density', 'medium_density',
        'hand', 'default'.
    exposure_us : float, optional
        Exposure of the colour camera, microseconds, which disables automatic exposure; 0 enables
        it.
    """

    preset: str | None = None
    exposure_us: float | None = None


_COLOR_STEP_US = 100.0  # unit of the colour exposure in the SDK


def apply_settings(rs: Any, device: Any, settings: CameraSettings, source: object) -> None:
    """Apply camera settings after checking their ranges.

    Parameters
    ----------
    rs : module
        The SDK.
    device : pyrealsense2.device
        The camera.
    settings : CameraSettings
        Settings to apply.
    source : object
        The camera, for error messages.

    Raises
    ------
    CameraError
        If the camera does not support a setting, or a value is out of range.
    """
    color, o = "RGB Camera", rs.option
    automatic = None if settings.exposure_us is None else float(settings.exposure_us == 0)
    exposure = settings.exposure_us / _COLOR_STEP_US if settings.exposure_us else None
    settings_by_sensor = (
        ("Stereo Module", o.visual_preset, _preset(rs, settings.preset, source)),
        (color, o.enable_auto_exposure, automatic),
        (color, o.exposure, exposure),
    )
    sensors = {sensor.get_info(rs.camera_info.name): sensor for sensor in device.query_sensors()}
    for sensor, option, value in settings_by_sensor:
        if value is not None:
            _set(sensors.get(sensor), sensor, option, value, source)


def _preset(rs: Any, name: str | None, source: object) -> float | None:
    if name is None:
        return None
    presets = rs.rs400_visual_preset.__members__
    key = name.strip().lower().replace("-", "_").replace(" ", "_")
    if key not in presets:
        raise CameraError(
            "no preset is called {name!r}",
            source=source,
            remedy="choose one of {presets}",
            name=name,
            presets=", ".join(sorted(presets)),
        )
    return float(int(presets[key]))


def _set(sensor: Any, name: str, option: Any, value: float, source: object) -> None:
    text = f"{name.lower()}'s {option.name.replace('_', ' ')}"
    if sensor is None or not sensor.supports(option):
        raise CameraError(
            "the {setting} cannot be set",
            source=source,
            remedy="leave that setting out",
            setting=text,
        )
    limits = sensor.get_option_range(option)
    if not limits.min <= value <= limits.max:
        raise CameraError(
            f"the {text} cannot be {value:g}",
            source=source,
            remedy=f"give {limits.min:g} to {limits.max:g}, in the camera's own steps",
        )
    try:
        sensor.set_option(option, value)
    except RuntimeError as error:
        raise camera_fault(error, source) from None
