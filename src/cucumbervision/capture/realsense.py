"""RealSense D4xx cameras: aligned frames and bursts, live or from a recording."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from cucumbervision.arrays import Array32, Pixels
from cucumbervision.capture.frames import Capture, Stop, fuse_burst
from cucumbervision.capture.intrinsics import Distortion, Intrinsics, Stream
from cucumbervision.capture.pictures import require_readings, scale_depth
from cucumbervision.errors import CameraError, CaptureError, MissingExtraError

_STEP_MS = 200

_TAIL_S = 0.5


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
        remedy = "install the system package libusb-1.0-0 (libusb1 on Fedora)"
        fault = "pyrealsense2 cannot be loaded ({reason})"
        raise CameraError(fault, remedy=remedy, reason=error) from None
    return pyrealsense2


# By a word in the SDK's text: fault and remedy.
_FAULTS = {
    "no device": (
        "no RealSense camera is connected",
        "plug a D4xx into a USB 3 port, or name a recording",
    ),
    "resolve": (
        "no connected camera streams that size and rate",
        "choose a size and rate of the camera, and check that it is at a USB 3 port",
    ),
    "busy": ("the camera is in use", "close the other program that uses it"),
    "": ("the camera failed ({reason})", "plug it in again"),
}


def camera_fault(error: RuntimeError, source: object) -> CameraError:
    """Convert an error of the SDK."""
    text = str(error)
    fault, remedy = next(value for word, value in _FAULTS.items() if word in text.lower())
    return CameraError(fault, source=source, remedy=remedy, reason=text)


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
    exposure, presets = settings.exposure_us, rs.rs400_visual_preset.__members__
    wanted: list[tuple[str, Any, float]] = []
    if settings.preset is not None:
        key = settings.preset.strip().lower().replace("-", "_").replace(" ", "_")
        if key not in presets:
            raise CameraError(
                "no preset is called {name!r}",
                source=source,
                remedy="choose one of {presets}",
                name=settings.preset,
                presets=", ".join(sorted(presets)),
            )
        wanted.append(("Stereo Module", rs.option.visual_preset, float(int(presets[key]))))
    if exposure is not None:
        wanted.append(("RGB Camera", rs.option.enable_auto_exposure, float(exposure == 0)))
    if exposure:
        wanted.append(("RGB Camera", rs.option.exposure, exposure / _COLOR_STEP_US))
    sensors = {sensor.get_info(rs.camera_info.name): sensor for sensor in device.query_sensors()}
    for name, option, value in wanted:
        sensor = sensors.get(name)
        text = f"{name.lower()}'s {option.name.replace('_', ' ')}"
        if sensor is None or not sensor.supports(option):
            fault, remedy = "the {setting} cannot be set", "leave that setting out"
            raise CameraError(fault, source=source, remedy=remedy, setting=text)
        limits = sensor.get_option_range(option)
        if not limits.min <= value <= limits.max:
            remedy = f"give {limits.min:g} to {limits.max:g}, in the camera's own steps"
            raise CameraError(f"the {text} cannot be {value:g}", source=source, remedy=remedy)
        try:
            sensor.set_option(option, value)
        except RuntimeError as error:
            raise camera_fault(error, source) from None


@dataclass(frozen=True, eq=False)
class AlignedFrame:
    """One colour image with the depth aligned to it.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 for no reading.
    number : int
        Frame number of the colour stream.
    timestamp_s : float, optional
        Seconds since the epoch; None if the camera's clock starts with the camera.
    gravity : tuple of float, optional
        Its direction in camera coordinates, where an accelerometer streams too.
    """

    color: Pixels
    depth_m: Array32
    number: int
    timestamp_s: float | None
    gravity: tuple[float, float, float] | None = None


def burst_capture(
    frames: Sequence[AlignedFrame],
    intrinsics: Intrinsics,
    name: str,
    *,
    place: object,
    **capture_fields: Any,
) -> Capture:
    """Fuse a burst to a capture; `place` is for error messages, the rest are further fields of it.

    Raises
    ------
    DepthError
        If no pixel of the burst has a reading between 0.1 and 5 m.
    """
    fused = fuse_burst([f.color for f in frames], [f.depth_m for f in frames])
    require_readings(fused.depth_m, source=place)
    return Capture(
        **vars(fused),
        intrinsics=intrinsics,
        name=name,
        frame=frames[0].number,
        timestamp_s=frames[fused.burst_frame].timestamp_s,
        gravity=frames[fused.burst_frame].gravity,
        **capture_fields,
    )


@dataclass(frozen=True)
class CameraConfig:
    """Streaming options of a camera.

    Parameters
    ----------
    serial : str, optional
        Serial number; by default the first camera found.
    width, height : int
        Size of both streams, pixels.
    fps : int
        Frames per second.
    burst : int
        Number of frames per capture.
    warm_up : int
        Number of frames dropped at the start, while exposure settles.
    timeout_s : float
        Maximum time to wait for a frame.
    playback : Path, optional
        Recording to play instead of a camera; size, rate and serial number are then those of the
        recording.
    settings : CameraSettings
        Exposure and presets; not for recordings.
    """

    serial: str | None = None
    width: int = 1280
    height: int = 720
    fps: int = 30
    burst: int = 5
    warm_up: int = 30
    timeout_s: float = 5.0
    playback: Path | None = None
    settings: CameraSettings = field(default_factory=CameraSettings)

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.fps, self.burst) < 1 or self.warm_up < 0:
            raise ValueError("size, fps and burst must be positive, warm_up not negative")
        if not self.timeout_s > 0:
            raise ValueError("timeout_s must be positive")


# Formats of a recording's colour, and OpenCV's names for what converts them.
_COLOR_CODES = {
    **{"bgr8": "COLOR_BGR2RGB", "rgba8": "COLOR_RGBA2RGB", "bgra8": "COLOR_BGRA2RGB"},
    **{"yuyv": "COLOR_YUV2RGB_YUYV", "uyvy": "COLOR_YUV2RGB_UYVY"},
}
_STALE_S, _QUEUED = 0.5, 2  # pause after which the queued frames of the SDK are dropped


class RealSenseCamera:
    """A camera as a context manager: `with RealSenseCamera() as camera: camera.capture_burst()`.

    Parameters
    ----------
    config : CameraConfig, optional
        Streaming options.

    Raises
    ------
    CameraError
        On entering, if the camera is not available or in use.
    CaptureError
        On entering, if a recording cannot be played.
    MissingExtraError
        On entering, if pyrealsense2 is not installed.
    """

    def __init__(self, config: CameraConfig | None = None) -> None:
        self.config = config or CameraConfig()
        file, serial = self.config.playback, self.config.serial
        self._is_recorded = file is not None
        self._source = file or (f"camera {serial}" if serial else "camera")
        self._pipeline: Any = None
        self._playback: Any = None
        self._resuming: threading.Thread | None = None
        self._taken_s = 0.0
        self.device: dict[str, str] = {}

    def __enter__(self) -> Self:
        self._rs = rs = import_realsense()
        config, pipeline = rs.config(), rs.pipeline()
        try:
            self._configure(config)
            device = config.resolve(rs.pipeline_wrapper(pipeline)).get_device()
            self._pipeline, self._reached_s = pipeline, 0.0
            self._playback = device.as_playback() if device.is_playback() else None
            if self._is_recorded:
                # The SDK starts reading with the first sensor and drops frames of the others. Pause
                # the playback until all sensors have started.
                self._playback.set_real_time(False)
                self._playback.pause()
            self._read_profile(pipeline.start(config))
            if self._is_recorded:
                # Afterwards 'stopped' means the end of the file.
                self._playback.pause()
                # This returns only when frames are read, so it must not block.
                self._resuming = threading.Thread(target=self._playback.resume, daemon=True)
                self._resuming.start()
            else:
                apply_settings(rs, device, self.config.settings, self._source)
            self.read_burst([], self.config.warm_up)
        except RuntimeError as error:
            self.close()
            raise self._fault(error) from None
        except BaseException:
            self.close()
            raise
        return self

    def _configure(self, config: Any) -> None:
        rs, c = self._rs, self.config
        if c.playback is not None:
            config.enable_device_from_file(str(c.playback), repeat_playback=False)
            return
        if c.serial:
            config.enable_device(c.serial)
        config.enable_stream(rs.stream.depth, c.width, c.height, rs.format.z16, c.fps)
        config.enable_stream(rs.stream.color, c.width, c.height, rs.format.rgb8, c.fps)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the pipeline and its threads, if it is running."""
        if self._pipeline is not None:
            # A camera that was unplugged or never started cannot be stopped, only released.
            with contextlib.suppress(RuntimeError):
                self._pipeline.stop()
        if self._resuming is not None:
            self._resuming.join(self.config.timeout_s)
        # SDK 2.59 crashes if the playback is destroyed while its reader thread has pending work:
        # tasks taken from the queue run on destroyed objects (`dispatcher::stop`, called by
        # `~playback_device`). `pause` returns when all queued tasks are done; the second call
        # includes tasks queued by earlier tasks.
        for _ in range(2 if self._playback is not None else 0):
            with contextlib.suppress(RuntimeError):
                self._playback.pause()
        self._pipeline = self._playback = self._resuming = None

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the colour stream at the streamed size, once it is open."""
        self._require_open()
        return self._intrinsics

    def _require_open(self) -> None:
        if self._pipeline is None:
            remedy = "use it in a 'with' block"
            raise CameraError("the camera is not open", source=self._source, remedy=remedy)

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        """Capture a burst and fuse it.

        Parameters
        ----------
        name : str, optional
            Name; by default 'capture_' and the number of its first frame.
        stop : Stop, optional
            Position in the greenhouse.

        Returns
        -------
        Capture
            Capture whose `frame` is the camera's number of the first frame.

        Raises
        ------
        CameraError
            If the camera is not open, sends no frame in time, or the played recording has ended.
        DepthError
            If no pixel of the burst has a reading between 0.1 and 5 m.
        """
        if self.config.playback is None and time.monotonic() - self._taken_s > _STALE_S:
            self.read_burst([], _QUEUED)  # queued frames were captured before this call
        frames: list[AlignedFrame] = []
        self.read_burst(frames, self.config.burst)
        if len(frames) < self.config.burst:
            fault, remedy = "the recording is over", "play a longer one"
            raise CameraError(fault, source=self._source, remedy=remedy)
        self._taken_s = time.monotonic()
        return burst_capture(
            frames,
            self.intrinsics,
            name or f"capture_{frames[0].number:06d}",
            place=self._source,
            stop=stop or Stop(),
            source=str(self._source),
            provenance={"reader": "camera", **self.device},
        )

    def read(self) -> AlignedFrame | None:
        """Return the next frame with both images; None at the end of a recording.

        Raises
        ------
        CameraError
            If a camera sends no frame in time or is disconnected.
        CaptureError
            If a recording is truncated.
        """
        self._require_open()
        deadline_s = time.monotonic() + self.config.timeout_s
        while time.monotonic() < deadline_s:
            try:
                if self._is_recorded:
                    # The position is reset to 0 when the last frame is in the queue.
                    reached_s = self._playback.get_position() / 1e9
                    self._reached_s = max(self._reached_s, reached_s)
                arrived, frames = self._pipeline.try_wait_for_frames(_STEP_MS)
                # The first frame sets may contain only one image.
                if arrived and frames.get_color_frame() and frames.get_depth_frame():
                    return self._convert(frames)
                if not arrived and self._is_over():
                    return None
            except RuntimeError as error:
                raise self._fault(error) from None
            if arrived and self._is_recorded:
                # A recording may contain a long section of only one stream, but it ends.
                deadline_s = time.monotonic() + self.config.timeout_s
        if self._is_recorded:
            raise CaptureError("the recording stalls", source=self._source, remedy="copy it again")
        raise CameraError(
            "no frame with colour and depth for {seconds:g} s",
            source=self._source,
            remedy="plug the camera in again, at a USB 3 port",
            seconds=self.config.timeout_s,
        )

    def read_burst(self, frames: list[AlignedFrame], size: int) -> None:
        """Append frames until there are `size` of them, or a recording ends; raises as `read`."""
        while len(frames) < size and (frame := self.read()) is not None:
            # In a recording a slower colour stream is repeated with each new depth frame.
            if not (self._is_recorded and frames and frame.number == frames[-1].number):
                frames.append(frame)

    def _is_over(self) -> bool:
        if not self._is_recorded:
            return False
        if self._playback.current_status() != self._rs.playback_status.stopped:
            return False
        # The SDK ends playback silently if it cannot read the rest of the file.
        length_s = self._playback.get_duration().total_seconds()
        if length_s - self._reached_s > _TAIL_S:
            raise CaptureError(
                f"no more frames can be read after {self._reached_s:.1f} s of {length_s:.1f} s",
                source=self._source,
                remedy="copy the recording again; the captures before are whole",
            )
        return True

    def _read_profile(self, profile: Any) -> None:
        rs = self._rs
        kinds = {s.stream_type() for s in profile.get_streams()}
        names = {rs.stream.color: "colour", rs.stream.depth: "depth"}
        if missing := [name for kind, name in names.items() if kind not in kinds]:
            fault, remedy = f"has no {missing[0]} stream", "record colour and depth together"
            raise CaptureError(fault, source=self._source, remedy=remedy)
        lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        k1, k2, p1, p2, k3 = (float(c) for c in lens.coeffs)
        pinhole = lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy
        self._intrinsics = Intrinsics(
            *pinhole, Stream.COLOR, self._lens_model(lens), (k1, k2, p1, p2, k3)
        )
        device = profile.get_device()
        # The SDK uses single precision: 0.0010000000475 is 0.001.
        scale = device.first_depth_sensor().get_depth_scale()
        self._unit_m = float(f"{scale:.6g}")
        info = rs.camera_info
        details = {"camera": info.name, "serial": info.serial_number}
        details["firmware"] = info.firmware_version
        self.device = {k: device.get_info(v) for k, v in details.items() if device.supports(v)}
        self._align = rs.align(rs.stream.color)

    def _lens_model(self, lens: Any) -> Distortion:
        name = str(lens.model).removeprefix("distortion.") if any(lens.coeffs) else "none"
        if name not in {*Distortion}:
            fault = f"the colour stream has the lens model {name}, which no D4xx has"
            raise CaptureError(fault, source=self._source, remedy="use a D4xx camera")
        return Distortion(name)

    def _convert(self, frames: Any) -> AlignedFrame:
        aligned = self._align.process(frames)
        color, depth = aligned.get_color_frame(), aligned.get_depth_frame()
        raw = np.asanyarray(depth.get_data())
        # An accelerometer at rest reads the push against gravity, along the axes of the images.
        accelerometer = frames.first_or_default(self._rs.stream.accel)
        push = accelerometer and accelerometer.as_motion_frame().get_motion_data()
        # Hardware clocks start with the camera.
        epoch = color.get_frame_timestamp_domain() != self._rs.timestamp_domain.hardware_clock
        return AlignedFrame(
            self._rgb(color),
            scale_depth(raw, self._unit_m),
            int(color.get_frame_number()),
            color.get_timestamp() / 1000 if epoch else None,
            (-push.x, -push.y, -push.z) if push else None,
        )

    def _rgb(self, frame: Any) -> Pixels:
        name = str(frame.get_profile().format()).removeprefix("format.")
        data = np.asanyarray(frame.get_data())
        if name == "rgb8":
            # Copy, because the SDK reuses its buffer.
            return np.array(data, dtype=np.uint8)
        if name not in _COLOR_CODES:
            fault = f"colour is {name}, which is not read"
            raise CaptureError(fault, source=self._source, remedy="record RGB8")
        if data.dtype == np.uint16:
            data = data.view(np.uint8).reshape(*data.shape, 2)
        return np.asarray(cv2.cvtColor(data, getattr(cv2, _COLOR_CODES[name])), dtype=np.uint8)

    def _fault(self, error: RuntimeError) -> CaptureError | CameraError:
        if not self._is_recorded:
            return camera_fault(error, self._source)
        return CaptureError(
            "is not a recording that can be played ({reason})",
            source=self._source,
            remedy="copy it again, or record it with RealSense Viewer",
            reason=str(error).rpartition("Reason: ")[2],
        )
