"""What of the ROS 2 node needs no ROS: messages made by hand, after the definitions of sensor_msgs.

rclpy is on no index that is used here, so the node itself was never run in these tests.
"""

from __future__ import annotations

import importlib.util
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.errors import CaptureError
from cucumbervision.geometry.camera import Distortion


@pytest.fixture(scope="module")
def node() -> ModuleType:
    path = Path(__file__).parents[2] / "examples" / "ros2_node.py"
    spec = importlib.util.spec_from_file_location("ros2_node", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


STAMP = SimpleNamespace(sec=1_700_000_000, nanosec=500_000_000)
HEADER = SimpleNamespace(frame_id="camera_color_optical_frame", stamp=STAMP)


def image(encoding: str, data: NDArray[Any], padding: int = 0, big: bool = False) -> Any:
    rows = data.reshape(data.shape[0], -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    return SimpleNamespace(
        header=HEADER,
        height=data.shape[0],
        width=data.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=padded.shape[1],
        data=padded.tobytes(),
    )


def info(model: str = "plumb_bob", lens: tuple[float, ...] = (0.0,) * 5) -> Any:
    k = [600.0, 0.0, 3.5, 0.0, 601.0, 2.5, 0.0, 0.0, 1.0]
    return SimpleNamespace(
        header=HEADER, height=6, width=8, distortion_model=model, d=list(lens), k=k
    )


COLOR = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
DEPTH = np.arange(300, 300 + 48, dtype=np.uint16).reshape(6, 8)


def test_messages_become_a_capture(node: ModuleType) -> None:
    capture = node.capture_of(image("rgb8", COLOR, 5), image("16UC1", DEPTH, 4), info())
    np.testing.assert_array_equal(capture.color, COLOR)
    np.testing.assert_allclose(capture.depth_m, DEPTH / 1000, rtol=1e-6)
    assert capture.intrinsics.fx_px == 600.0
    assert capture.intrinsics.cy_px == 2.5
    assert capture.intrinsics.distortion is Distortion.NONE
    assert capture.timestamp_s == 1_700_000_000.5
    assert capture.name == "frame_1700000000_500000000"


def test_other_encodings_are_the_same_picture(node: ModuleType) -> None:
    bgra = np.dstack([COLOR[..., ::-1], np.full((6, 8), 255, np.uint8)])
    metres = (DEPTH / 1000).astype(np.float32)
    metres[0, 0] = np.nan  # REP 118: no reading
    capture = node.capture_of(image("bgra8", bgra), image("32FC1", metres), info())
    np.testing.assert_array_equal(capture.color, COLOR)
    assert capture.depth_m[0, 0] == 0.0
    other = image("16UC1", DEPTH.astype(">u2"), big=True)
    big = node.capture_of(image("rgb8", COLOR), other, info())
    np.testing.assert_allclose(big.depth_m, DEPTH / 1000, rtol=1e-6)


def test_a_lens_is_kept(node: ModuleType) -> None:
    lens = (0.1, -0.05, 0.001, -0.002, 0.01)
    capture = node.capture_of(image("rgb8", COLOR), image("16UC1", DEPTH), info(lens=lens))
    assert capture.intrinsics.distortion is Distortion.BROWN_CONRADY
    assert capture.intrinsics.coefficients == lens


@pytest.mark.parametrize(
    ("color", "depth", "camera", "fault"),
    [
        ("yuv422", "16UC1", info(), "yuv422 with depth 16UC1 is not supported"),
        ("rgb8", "8UC1", info(), "depth 8UC1 is not supported"),
        ("rgb8", "16UC1", info("equidistant", (0.1, 0, 0, 0)), "equidistant is not supported"),
    ],
)
def test_what_is_not_read_is_said(
    node: ModuleType, color: str, depth: str, camera: Any, fault: str
) -> None:
    with pytest.raises(CaptureError, match=fault):
        node.capture_of(image(color, COLOR), image(depth, DEPTH), camera)


def test_the_newest_is_worked_on_and_older_ones_are_dropped(node: ModuleType) -> None:
    begun, go, done = threading.Event(), threading.Event(), threading.Event()
    worked: list[int] = []

    def work(one: int) -> None:
        worked.append(one)
        begun.set()
        go.wait(30)
        if one == 4:
            done.set()

    newest = node.Newest(work)
    newest.give(1)
    assert begun.wait(30)
    for one in (2, 3, 4):
        newest.give(one)
    go.set()
    assert done.wait(30)
    assert worked == [1, 4]
