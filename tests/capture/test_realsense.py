"""The real SDK without hardware: software device, recorder, playback, alignment."""

from __future__ import annotations

import sqlite3
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.intrinsics import Distortion, Intrinsics, Stream, align_depth_to_color
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.capture.realsense import (
    CameraConfig,
    CameraSettings,
    RealSenseCamera,
    apply_settings,
    camera_fault,
    list_cameras,
)
from cucumbervision.errors import CameraError, CaptureError, IntrinsicsError, MissingExtraError

pytest.importorskip("pyrealsense2", exc_type=ImportError)

DEPTH_K = np.array([[160.0, 0, 160.3], [0, 160.0, 89.7], [0, 0, 1]])
COLOR_K = np.array([[227.6, 0, 161.3], [0, 227.4, 91.5], [0, 0, 1]])
SHIFT_M = (0.015, 0.0003, 0.0002)


def block_edges_px(z_m: float) -> tuple[float, float, float, float]:
    """Where the block's edges (99.5 to 199.5, 79.5 to 99.5 px in depth) lie in colour."""
    x = [((u - 160.3) / 160 * z_m + 0.015) / (z_m + 0.0002) * 227.6 + 161.3 for u in (99.5, 199.5)]
    y = [((v - 89.7) / 160 * z_m + 0.0003) / (z_m + 0.0002) * 227.4 + 91.5 for v in (79.5, 99.5)]
    return x[0], x[1], y[0], y[1]


def test_recording_becomes_bursts(recording: Path, scene: Callable[[int], tuple[Any, Any]]) -> None:
    source = open_source(recording)
    assert (source.kind, source.total) == ("recording", None)
    captures = [ref.load() for ref in source]
    # Frames 1 to 22 make bursts of 5, 5, 5, 5 and 2.
    assert [c.frame for c in captures] == [1, 6, 11, 16, 21]
    assert [c.burst_size for c in captures] == [5, 5, 5, 5, 2]
    assert captures[1].name == "walk_000006"
    np.testing.assert_array_equal(captures[0].color, scene(2)[1])
    # The sharpest is the third of each five; the last burst holds none, so its first stays.
    assert [c.burst_frame for c in captures] == [2, 2, 2, 2, 0]
    first = captures[0]
    assert first.intrinsics.stream is Stream.COLOR
    np.testing.assert_allclose(first.intrinsics.matrix, COLOR_K, rtol=1e-6)
    assert first.provenance == {"reader": "recording", "camera": "Software D435", "serial": "0042"}
    # The software device's clock: 33.3 ms a frame, of the third.
    assert first.timestamp_s == pytest.approx(0.0999)


def test_an_accelerometer_tells_gravity(recording: Path) -> None:
    push = SimpleNamespace(x=0.5, y=-9.7, z=1.0)
    motion = SimpleNamespace(as_motion_frame=lambda: SimpleNamespace(get_motion_data=lambda: push))
    with RealSenseCamera(CameraConfig(playback=recording, warm_up=1)) as camera:
        aligned = camera._align.process(camera._pipeline.wait_for_frames())
        camera._align = SimpleNamespace(process=lambda _: aligned)
        frame = camera._convert(SimpleNamespace(first_or_default=lambda _: motion))
    assert frame.gravity == (-0.5, 9.7, -1.0)


def test_recording_is_aligned_where_the_hand_says(recording: Path) -> None:
    capture = next(iter(open_source(recording))).load()
    # Readings 450 to 454 mm: median 452.
    block = capture.depth_m == np.float32(0.452)
    ys, xs = np.nonzero(block)
    x0, x1, y0, y1 = block_edges_px(0.452)
    # Every pixel that a footprint touches is covered, so edges lie within one pixel outside.
    assert xs.min() == pytest.approx(x0, abs=1.0)
    assert xs.max() == pytest.approx(x1, abs=1.0)
    assert ys.min() == pytest.approx(y0, abs=1.0)
    assert ys.max() == pytest.approx(y1, abs=1.0)
    # 100 depth pixels at 160 px are 0.2825 m at 0.452 m; so they are in the colour camera.
    width_m = (xs.max() - xs.min()) / capture.intrinsics.fx_px * 0.452
    assert width_m == pytest.approx(100 / 160 * 0.452, rel=0.01)


def test_our_alignment_is_the_sdks(
    software_camera: Callable[..., Any], scene: Callable[[int], tuple[Any, Any]]
) -> None:
    camera = software_camera()
    depth, color = scene(0)
    rng = np.random.default_rng(1)
    depth = depth + rng.integers(0, 9, depth.shape, dtype=np.uint16)
    depth[rng.random(depth.shape) < 0.1] = 0
    frames = camera.push(depth, color)
    while frames.size() < 2:
        frames = camera.push(depth, color)
    aligned = camera.rs.align(camera.rs.stream.color).process(frames).get_depth_frame()
    expected = np.asanyarray(aligned.get_data())
    ours = align_depth_to_color(
        depth.astype(np.float32) * np.float32(0.001),
        Intrinsics.from_matrix(DEPTH_K, 320, 180),
        Intrinsics.from_matrix(COLOR_K, 320, 180),
        np.eye(3),
        SHIFT_M,
    )
    different = np.rint(ours * 1000).astype(int) != expected
    # The SDK's single precision decides otherwise where a footprint ends on a pixel's edge.
    assert different.mean() < 1e-3


def test_lens_model_of_the_recording(make_recording: Callable[..., Path], tmp_path: Path) -> None:
    lens = (0.1, -0.05, 0.001, -0.002, 0.01)
    path = make_recording(
        tmp_path / "lens.db3", 3, model="inverse_brown_conrady", coefficients=lens
    )
    capture = next(iter(open_source(path))).load()
    assert capture.intrinsics.distortion is Distortion.INVERSE_BROWN_CONRADY
    assert capture.intrinsics.coefficients == pytest.approx(lens)


def test_an_iterator_left_half_way_lets_the_file_go(recording: Path) -> None:
    source = open_source(recording, ReadOptions(burst=2))
    for _ in range(3):
        refs = iter(source)
        assert next(refs).frame == 1
        refs.close()  # type: ignore[attr-defined]
    threads = threading.active_count()
    assert [r.frame for r in source] == list(range(1, 23, 2))
    assert threading.active_count() == threads


def test_depth_intrinsics_for_a_recording_are_refused(recording: Path, tmp_path: Path) -> None:
    given = tmp_path / "depth.json"
    given.write_text(
        '{"stream": "depth", "width": 320, "height": 180,'
        ' "fx": 160, "fy": 160, "cx": 160.3, "cy": 89.7}'
    )
    # 227.6 / 160 - 1
    with pytest.raises(IntrinsicsError, match=r"depth\.json.*\+42 %"):
        open_source(recording, ReadOptions(intrinsics=given))


@pytest.mark.parametrize("ending", [".db3", ".bag"])
@pytest.mark.parametrize("content", [b"", b"no recording" * 40])
def test_what_is_no_recording_is_refused(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"bad{ending}"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=f"bad{ending}: is not a recording"):
        open_source(path)


def test_damage_in_the_middle_keeps_what_came_before(
    make_recording: Callable[..., Path], tmp_path: Path
) -> None:
    path = make_recording(tmp_path / "damaged.db3", 20, pause_s=0.06)
    # The file itself stays whole; the second half of its messages is not what it was.
    with closing(sqlite3.connect(path)) as file:
        file.execute(
            "UPDATE messages SET data = x'00' WHERE id > (SELECT MAX(id) / 2 FROM messages)"
        )
        file.commit()
    refs = list(open_source(path, ReadOptions(burst=2)))
    assert refs[0].load().frame == 1
    assert len(refs) > 2
    with pytest.raises(CaptureError, match=r"damaged\.db3: no more frames can be read after"):
        refs[-1].load()


def test_recording_without_color_is_refused(
    make_recording: Callable[..., Path], tmp_path: Path
) -> None:
    path = make_recording(tmp_path / "blind.db3", 3, color=False)
    with pytest.raises(CaptureError, match=r"blind\.db3.*colour"):
        list(open_source(path))


def test_recording_whose_color_never_comes(
    make_recording: Callable[..., Path], tmp_path: Path
) -> None:
    path = make_recording(tmp_path / "late.db3", 4, convert=lambda _: None)
    (ref,) = open_source(path)
    with pytest.raises(CaptureError, match=r"late\.db3: has no frame with both colour and depth"):
        ref.load()


@pytest.mark.parametrize(
    ("pixels", "size", "code"),
    [
        ("bgr8", 3, cv2.COLOR_RGB2BGR),
        ("rgba8", 4, cv2.COLOR_RGB2RGBA),
        ("bgra8", 4, cv2.COLOR_RGB2BGRA),
        ("yuyv", 2, cv2.COLOR_RGB2YUV_YUY2),
        ("uyvy", 2, cv2.COLOR_RGB2YUV_UYVY),
    ],
)
def test_color_formats(
    pixels: str,
    size: int,
    code: int,
    make_recording: Callable[..., Path],
    scene: Callable[[int], tuple[Any, Any]],
    tmp_path: Path,
) -> None:
    def convert(color: Any) -> Any:
        color[..., 0] //= 2  # so that red and blue are not alike
        return cv2.cvtColor(color, code)

    path = make_recording(tmp_path / "a.db3", 2, convert=convert, pixels=pixels, pixel_bytes=size)
    capture = next(iter(open_source(path, ReadOptions(burst=1)))).load()
    expected = scene(0)[1]
    expected[..., 0] //= 2
    np.testing.assert_allclose(capture.color.astype(int), expected, atol=3)


def test_other_color_formats_and_lenses_are_refused(
    make_recording: Callable[..., Path], tmp_path: Path
) -> None:
    path = make_recording(
        tmp_path / "grey.db3", 2, convert=lambda c: c[..., 0], pixels="y8", pixel_bytes=1
    )
    (ref,) = open_source(path)
    with pytest.raises(CaptureError, match=r"grey\.db3: colour is y8, which is not read"):
        ref.load()
    path = make_recording(tmp_path / "fish.db3", 2, model="ftheta", coefficients=(0.1, 0, 0, 0, 0))
    with pytest.raises(CaptureError, match=r"fish\.db3: .*lens model ftheta"):
        open_source(path)


def test_camera_plays_a_recording_through_the_same_driver(recording: Path) -> None:
    config = CameraConfig(playback=recording, warm_up=2, burst=5)
    with RealSenseCamera(config) as camera:
        assert camera.intrinsics.size == (320, 180)
        capture = camera.capture_burst("row1", stop=Stop(row="1"))
        assert (capture.name, capture.frame, capture.burst_size) == ("row1", 3, 5)
        assert capture.stop.row == "1"
        # Frames 3 to 7 read 452 to 456 mm.
        assert np.float32(0.454) in capture.depth_m
        assert camera.capture_burst().name == "capture_000008"
        # Five frames a burst, and fewer than twenty are left.
        with pytest.raises(CameraError, match="over"):
            _ = [camera.capture_burst() for _ in range(4)]
    with pytest.raises(CameraError, match="not open"):
        camera.capture_burst()
    # A camera can be opened again, and two may play one file.
    with camera, RealSenseCamera(config) as other:
        assert camera.capture_burst().frame == other.capture_burst().frame == 3


def test_no_camera() -> None:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    if len(rs.context().query_devices()):
        pytest.skip("a camera is connected")
    with pytest.raises(CameraError, match="no RealSense camera is connected; plug"):
        RealSenseCamera().__enter__()
    with pytest.raises(CameraError, match=r"camera 0042: no RealSense camera"):
        RealSenseCamera(CameraConfig(serial="0042")).__enter__()


def test_a_live_stream_that_dries_up(recording: Path) -> None:
    # Taken for live, a recording paces itself by the clock and then sends nothing more.
    stream = RealSenseCamera(CameraConfig(playback=recording, warm_up=0, timeout_s=0.4))
    stream._is_recorded = False
    with stream, pytest.raises(CameraError, match=r"no frame .* for 0\.4 s; plug"):
        _ = [stream.read() for _ in range(30)]


def test_package_or_library_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingExtraError, match="camera"):
        open_source(path)
    # A package that fails as pyrealsense2 does where the system lacks libusb.
    monkeypatch.delitem(sys.modules, "pyrealsense2")
    (tmp_path / "pyrealsense2.py").write_text(
        "raise ImportError('libusb-1.0.so.0: cannot open shared object file')"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(CameraError, match=r"libusb-1\.0-0"):
        open_source(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("No device connected", "no RealSense camera is connected"),
        ("Couldn't resolve requests", "no connected camera streams that size and rate"),
        ("xioctl(VIDIOC_S_FMT) failed Last Error: Device or resource busy", "is in use"),
        ("Device disconnected", r"the camera failed \(Device disconnected\)"),
    ],
)
def test_what_the_sdk_says_of_a_camera_is_named(text: str, words: str) -> None:
    with pytest.raises(CameraError, match=rf"^camera: .*{words}"):
        raise camera_fault(RuntimeError(text), "camera")


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
