from __future__ import annotations

import doctest
import logging
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray
from tests.constant_network import constant_network

from cucumbervision.arrays import Array, Array32, Numbers, Pixels
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.scenes.bodies import Tube
from cucumbervision_lab.scenes.scene import Kind, Scene, View, render

# The same examples in every run: a new one belongs to whoever looks for it (`pytest
# --hypothesis-profile=default`), not to whoever changed something else.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture
def camera() -> Intrinsics:
    """A D435's colour camera at 1280x720, rounded."""
    return Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)


@pytest.fixture
def helix() -> Callable[[float, float, float], Array]:
    """Draw a helix along x about the origin: 2000 points of its radius, its pitch, its turns."""

    def points(radius_m: float, pitch_m: float, turns: float) -> Array:
        turn = np.linspace(-turns * np.pi, turns * np.pi, 2000)
        along = pitch_m * turn / (2 * np.pi)
        return np.stack([along, radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1)

    return points


@pytest.fixture
def shared_data() -> Path:
    """The folder of real captures, which never comes with the project."""
    folder = os.environ.get("CUCUMBERVISION_DATA")
    if not folder:
        pytest.skip("CUCUMBERVISION_DATA names no folder of real captures")
    return Path(folder)


@pytest.fixture
def run_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Path], doctest.TestResults]:
    """Run a page's examples in an empty folder."""

    def run(page: Path) -> doctest.TestResults:
        monkeypatch.chdir(tmp_path)
        return doctest.testfile(
            str(page),
            module_relative=False,
            optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS,
            encoding="utf-8",
        )

    return run


def capture_of(scene: View, camera: Intrinsics, fruit: int = 1, name: str = "drawn") -> Capture:
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    color[scene.kind == Kind.FRUIT] = (60, 140, 50)
    masks = tuple(scene.mask(k) for k in range(fruit))
    return Capture(color, scene.depth_m.astype(np.float32), camera, name, masks=masks)


def draw(tube: Tube, camera: Intrinsics, backdrop_m: float = 0.0) -> tuple[Capture, View]:
    scene = render(Scene.of(tube, backdrop_m=backdrop_m), camera)
    return capture_of(scene, camera), scene


def depth32(scene: View) -> Array32:
    return scene.depth_m.astype(np.float32)


# A RealSense camera without hardware: the SDK's own `software_device`, recorded and played.

WIDTH, HEIGHT = 320, 180
# A D435's ratios at a quarter of its size: the colour camera sees 1.42 times larger.
DEPTH_K = (160.0, 160.0, 160.3, 89.7)
COLOR_K = (227.6, 227.4, 161.3, 91.5)
SHIFT_M = (0.015, 0.0003, 0.0002)


class SoftwareCamera:
    """Colour and depth with distinct intrinsics and an extrinsic, pushed frame by frame."""

    def __init__(
        self,
        record_to: Path | None = None,
        *,
        model: str = "brown_conrady",
        coefficients: tuple[float, ...] = (0.0,) * 5,
        color: bool = True,
        pixels: str = "rgb8",
        pixel_bytes: int = 3,
        enlarged: int = 1,
    ) -> None:
        self._enlarged = enlarged
        self.rs: Any = pytest.importorskip("pyrealsense2", exc_type=ImportError)
        rs = self.rs
        device = rs.software_device()
        device.register_info(rs.camera_info.name, "Software D435")
        device.register_info(rs.camera_info.serial_number, "0042")
        depth, rgb = device.add_sensor("Stereo Module"), device.add_sensor("RGB Camera")
        self.depth_profile = self._profile(depth, rs.stream.depth, rs.format.z16, 2, 1, DEPTH_K)
        self.color_profile = self._profile(
            rgb,
            rs.stream.color,
            getattr(rs.format, pixels),
            pixel_bytes,
            2,
            COLOR_K,
            model,
            coefficients,
        )
        depth.add_read_only_option(rs.option.depth_units, 0.001)
        depth.add_read_only_option(rs.option.stereo_baseline, 50.0)
        extrinsics = rs.extrinsics()
        extrinsics.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
        extrinsics.translation = list(SHIFT_M)
        self.depth_profile.register_extrinsics_to(self.color_profile, extrinsics)
        device.create_matcher(rs.matchers.dlr_c)
        self._device = device
        self._recorder = rs.recorder(str(record_to), device) if record_to else None
        # Frames go into the device's own sensors; who records opens the recorder's.
        used = 2 if color else 1
        self._inlets = [depth, rgb][:used]
        self._sensors = (self._recorder.query_sensors() if self._recorder else [depth, rgb])[:used]
        self._profiles = [self.depth_profile, self.color_profile][:used]
        self._syncer = rs.syncer(10)
        for sensor, profile in zip(self._sensors, self._profiles, strict=True):
            sensor.open(profile)
            sensor.start(self._syncer)
        self._count = 0

    def _profile(
        self,
        sensor: Any,
        kind: Any,
        pixels: Any,
        size: int,
        uid: int,
        k: tuple[float, ...],
        model: str = "brown_conrady",
        coefficients: tuple[float, ...] = (0.0,) * 5,
    ) -> Any:
        rs = self.rs
        lens, stream = rs.intrinsics(), rs.video_stream()
        lens.width, lens.height = WIDTH * self._enlarged, HEIGHT * self._enlarged
        lens.fx, lens.fy, lens.ppx, lens.ppy = (self._enlarged * value for value in k)
        lens.model, lens.coeffs = getattr(rs.distortion, model), list(coefficients)
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid, 30
        stream.width, stream.height, stream.bpp, stream.fmt = lens.width, lens.height, size, pixels
        stream.intrinsics = lens
        return sensor.add_video_stream(stream).as_video_stream_profile()

    def push(self, depth_mm: NDArray[np.uint16], color: Pixels | None) -> Any:
        """Send one frame; gives the frameset that the SDK made of it."""
        self._count += 1
        images: list[Numbers] = [depth_mm] if color is None else [depth_mm, color]
        for inlet, profile, image in zip(self._inlets, self._profiles, images, strict=False):
            frame = self.rs.software_video_frame()
            large = image.repeat(self._enlarged, axis=0).repeat(self._enlarged, axis=1)
            frame.pixels = np.ascontiguousarray(large)
            frame.bpp = image.dtype.itemsize * (image.shape[2] if image.ndim == 3 else 1)
            frame.stride = large.shape[1] * frame.bpp
            frame.timestamp, frame.frame_number = 33.3 * self._count, self._count
            frame.domain, frame.profile = self.rs.timestamp_domain.system_time, profile
            if image.ndim == 2:
                frame.depth_units = 0.001
            inlet.on_video_frame(frame)
        return self._syncer.wait_for_frames(2000)

    def stop(self) -> None:
        """Stop the sensors and finish the recording."""
        for sensor in self._sensors:
            sensor.stop()
            sensor.close()
        # The recorder finishes its file when nothing holds it any more.
        self._sensors, self._recorder = [], None


def block_scene(index: int) -> tuple[NDArray[np.uint16], Pixels]:
    """A wall at 600 mm, before it a block at 450 mm; each frame reads 1 mm more than the last."""
    depth = np.full((HEIGHT, WIDTH), 600, np.uint16)
    depth[80:100, 100:200] = 450 + index
    color = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    # The third of each five frames is the sharpest.
    step = 100 if index % 5 == 2 else 20
    color[80:100, 100:200] = 90 + step
    return depth, color


def record(
    path: Path,
    frames: int,
    *,
    pause_s: float = 0.0,
    convert: Callable[[Pixels], Pixels | None] | None = None,
    scene: Callable[[int], tuple[NDArray[np.uint16], Pixels]] = block_scene,
    **camera: Any,
) -> Path:
    """Record `frames` of a scene, its colour converted to what the stream carries."""
    device = SoftwareCamera(path, **camera)
    for index in range(frames):
        depth, color = scene(index)
        device.push(depth, convert(color) if convert else color)
        time.sleep(pause_s)
    device.stop()
    return path


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty-two frames of `block_scene`, recorded by the SDK."""
    return record(tmp_path_factory.mktemp("recording") / "walk.db3", 22)


@pytest.fixture
def software_camera() -> Iterator[Callable[..., SoftwareCamera]]:
    """Make software cameras, stopped at the end."""
    made: list[SoftwareCamera] = []

    def make(**options: Any) -> SoftwareCamera:
        made.append(SoftwareCamera(**options))
        return made[-1]

    yield make
    for camera in made:
        camera.stop()


@pytest.fixture(scope="session")
def make_recording() -> Callable[..., Path]:
    """Give `record`, for recordings that are out of the ordinary."""
    return record


@pytest.fixture(scope="session")
def scene() -> Callable[[int], tuple[NDArray[np.uint16], Pixels]]:
    """Give `block_scene`."""
    return block_scene


@pytest.fixture
def one_box_detector(tmp_path: Path) -> Path:
    """A detecting network that finds one box, whatever it sees."""
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, 0] = [8, 8, 40, 30, 0.75, 0]
    props = {"names": {0: "cucumber"}, "task": "detect", "end2end": True, "stride": 32}
    path = tmp_path / "one-box.onnx"
    path.write_bytes(constant_network(rows, props=props))
    return path


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the command in this process, as its console script does: exit code, what it printed."""

    def run_here(*arguments: object) -> subprocess.CompletedProcess[str]:
        from cucumbervision.cli.app import main

        words = [str(argument) for argument in arguments]
        monkeypatch.setattr("sys.argv", ["cucumbervision", *words])
        capfd.readouterr()
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        return subprocess.CompletedProcess(words, code, *capfd.readouterr())

    return run_here


# A real browser. Its tests wait as long as a machine that does much else needs.

PATIENCE_S = 300.0
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
SAID = logging.getLogger("page")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests in a browser a limit that no busy machine reaches."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.timeout(1800))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A real Chromium."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def new_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Open an empty page in a browser context of its own; a failure shows its log and its end."""
    contexts: list[Any] = []

    def opened(width: int = 1280, height: int = 800, **how: Any) -> Any:
        contexts.append(browser.new_context(viewport={"width": width, "height": height}, **how))
        contexts[-1].set_default_timeout(1000 * PATIENCE_S)
        page = contexts[-1].new_page()
        page.on("console", lambda line: SAID.warning("console: %s", line.text))
        page.on("pageerror", lambda error: SAID.warning("page error: %s", error))
        page.on("requestfailed", lambda one: SAID.warning("%s: %s", one.url, one.failure))
        return page

    yield opened
    for context in contexts:
        for page in context.pages:
            SAID.warning("%s ends with: %s", page.url, page.evaluate("document.body.innerText"))
        context.close()
