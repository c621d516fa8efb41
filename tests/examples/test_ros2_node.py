"""The ROS 2 node without ROS: messages made by hand, after the definitions of their packages.

rclpy is on no index that is used here. `message` makes types that, like rclpy's, have only the
fields of the definitions and take only values of their types; the middleware was never tried.
"""

from __future__ import annotations

import io
import json
import threading
from copy import deepcopy
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.fruit.instance import Instance
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import PlugIns
from cucumbervision.service.app import ServiceSettings, Work


@pytest.fixture(scope="module")
def node() -> ModuleType:
    import ros2_node  # type: ignore[import-not-found]

    return ros2_node  # type: ignore[no-any-return]


def message(name: str, constants: dict[str, int] | None = None, /, **fields: Any) -> Any:
    """Return a message type: each field's default is of the type that it takes."""

    def start(self: Any, **values: Any) -> None:
        for key, default in fields.items():
            value = default() if isinstance(default, type) else deepcopy(default)
            object.__setattr__(self, key, value)
        for key, value in values.items():
            setattr(self, key, value)

    def take(self: Any, key: str, value: Any) -> None:
        assert key in fields, f"{name} has no field {key}"
        wanted = type(getattr(self, key))
        assert type(value) is wanted, f"{name}.{key} takes {wanted.__name__}, got {type(value)}"
        if key == "covariance":
            assert len(value) == 36
        object.__setattr__(self, key, value)

    return type(name, (), {"__init__": start, "__setattr__": take, **(constants or {})})


Header = message("Header", stamp=SimpleNamespace, frame_id="")
Point = message("Point", x=0.0, y=0.0, z=0.0)
Vector3 = message("Vector3", x=0.0, y=0.0, z=0.0)
Quaternion = message("Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
Pose = message("Pose", position=Point, orientation=Quaternion)
PoseWithCovariance = message("PoseWithCovariance", pose=Pose, covariance=[0.0] * 36)
PoseArray = message("PoseArray", header=Header, poses=[])
ObjectHypothesis = message("ObjectHypothesis", class_id="", score=0.0)
ObjectHypothesisWithPose = message(
    "ObjectHypothesisWithPose", hypothesis=ObjectHypothesis, pose=PoseWithCovariance
)
BoundingBox3D = message("BoundingBox3D", center=Pose, size=Vector3)
Detection3D = message("Detection3D", header=Header, results=[], bbox=BoundingBox3D, id="")
Detection3DArray = message("Detection3DArray", header=Header, detections=[])
ColorRGBA = message("ColorRGBA", r=0.0, g=0.0, b=0.0, a=0.0)
Marker = message(
    "Marker",
    {"SPHERE_LIST": 7, "ADD": 0, "DELETEALL": 3},
    header=Header,
    ns="",
    id=0,
    type=0,
    action=0,
    pose=Pose,
    scale=Vector3,
    color=ColorRGBA,
    points=[],
)
MarkerArray = message("MarkerArray", markers=[])
MSGS = SimpleNamespace(
    Point=Point,
    Pose=Pose,
    PoseArray=PoseArray,
    Detection3D=Detection3D,
    Detection3DArray=Detection3DArray,
    ObjectHypothesisWithPose=ObjectHypothesisWithPose,
    Marker=Marker,
    MarkerArray=MarkerArray,
)
HEADER = Header(frame_id="camera_color_optical_frame")


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
    return SimpleNamespace(height=6, width=8, distortion_model=model, d=list(lens), k=k)


COLOR = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
DEPTH = np.arange(300, 300 + 48, dtype=np.uint16).reshape(6, 8)


def test_messages_become_arrays(node: ModuleType) -> None:
    arrays = node.arrays_of(image("rgb8", COLOR, 5), image("16UC1", DEPTH, 4), info())
    np.testing.assert_array_equal(arrays["color"], COLOR)
    np.testing.assert_allclose(arrays["depth"], DEPTH / 1000, rtol=1e-6)
    assert arrays["matrix"].tolist() == [[600.0, 0, 3.5], [0, 601.0, 2.5], [0, 0, 1]]


def test_other_encodings_are_the_same_picture(node: ModuleType) -> None:
    bgra = np.dstack([COLOR[..., ::-1], np.full((6, 8), 255, np.uint8)])
    metres = (DEPTH / 1000).astype(np.float32)
    metres[0, 0] = np.nan  # REP 118: no reading
    arrays = node.arrays_of(image("bgra8", bgra), image("32FC1", metres), info())
    np.testing.assert_array_equal(arrays["color"], COLOR)
    assert arrays["depth"][0, 0] == 0.0
    other = image("16UC1", DEPTH.astype(">u2"), big=True)
    big = node.arrays_of(image("rgb8", COLOR), other, info())
    np.testing.assert_allclose(big["depth"], DEPTH / 1000, rtol=1e-6)


def test_a_lens_of_eight_coefficients_is_taken_out(node: ModuleType) -> None:
    lens = (0.3, -0.1, 0.001, -0.002, 0.02, 0.5, -0.05, 0.01)
    size, matrix = (640, 480), np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    place = np.array([[[0.20, -0.15, 0.5]]])
    seen = cv2.projectPoints(place, np.zeros(3), np.zeros(3), matrix, np.array(lens))[0].ravel()
    straight = (matrix @ (place.ravel() / 0.5))[:2]
    assert np.linalg.norm(seen - straight) > 3
    depth = np.zeros((480, 640), np.uint16)
    u, v = np.rint(seen).astype(int)
    depth[v - 3 : v + 4, u - 3 : u + 4] = 500
    camera = SimpleNamespace(
        width=size[0],
        height=size[1],
        distortion_model="rational_polynomial",
        d=list(lens),
        k=matrix.ravel().tolist(),
    )
    blank = np.zeros((480, 640, 3), np.uint8)
    arrays = node.arrays_of(image("rgb8", blank), image("16UC1", depth), camera)
    rows, columns = np.nonzero(arrays["depth"])
    assert np.array([columns.mean(), rows.mean()]) == pytest.approx(straight, abs=1.0)
    assert set(np.unique(arrays["depth"])) == {np.float32(0), np.float32(0.5)}


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
    with pytest.raises(ValueError, match=fault):
        node.arrays_of(image(color, COLOR), image(depth, DEPTH), camera)


@pytest.fixture(scope="module")
def reply(node: ModuleType) -> dict[str, Any]:
    """The service's reply to a bundled capture, as the node asks for it."""
    capture = next(iter(open_source(example_captures() / "simulated-row-a"))).load()
    fruit = [Instance.of_mask(mask) for mask in capture.masks]
    work = Work(Measurer(plug_ins=PlugIns(detector=lambda _: fruit)), ServiceSettings())
    sent: list[tuple[str, io.BytesIO]] = []

    def answer(request: Any, timeout: float) -> Any:
        border = request.data.partition(b"\r\n")[0]
        for part in request.data.split(border)[1:-1]:
            head, _, rest = part.partition(b"\r\n\r\n")
            name = head.rpartition(b'filename="')[2].rstrip(b'"').decode()
            sent.append((name, io.BytesIO(rest.removesuffix(b"\r\n"))))
        answered = work.measure(sent)
        return io.BytesIO(json.dumps(answered.model_dump(mode="json")).encode())

    arrays = {"color": capture.color, "depth": capture.depth_m, "matrix": capture.intrinsics.matrix}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(node.urllib.request, "urlopen", answer)
        found: dict[str, Any] = node.ask("http://127.0.0.1:8600", arrays)
    assert sent
    return found


def turned(orientation: Any) -> NDArray[np.float64]:
    q = [orientation.x, orientation.y, orientation.z, orientation.w]
    return np.asarray(Rotation.from_quat(q).apply([1.0, 0.0, 0.0]))


def test_the_reply_becomes_standard_messages(node: ModuleType, reply: dict[str, Any]) -> None:
    poses = [fruit["pose"] for fruit in reply["captures"][0]["fruit"]]
    assert len(poses) == 3
    found = node.detections(MSGS, HEADER, reply)
    for one, pose in zip(found.detections, poses, strict=True):
        run = np.subtract(pose["stem_m"], pose["blossom_m"])
        assert turned(one.bbox.center.orientation) == pytest.approx(
            run / np.linalg.norm(run), abs=1e-3
        )
        assert one.bbox.size.x == pytest.approx(float(np.linalg.norm(run)), abs=0.003)
        assert 0.02 < one.bbox.size.y == one.bbox.size.z < 0.12
        if pose["cut_m"] is not None:
            (result,) = one.results
            assert turned(result.pose.pose.orientation) == pytest.approx(
                pose["direction"], abs=1e-4
            )
            block = np.array(result.pose.covariance).reshape(6, 6)
            assert block[:3, :3] == pytest.approx(np.array(pose["cut_covariance_m2"]))
            assert (np.linalg.eigvalsh(block) > 0).all()
    cut = [pose["cut_m"] for pose in poses if pose["cut_m"] is not None]
    assert cut
    assert [
        [one.position.x, one.position.y, one.position.z]
        for one in node.cuts(MSGS, HEADER, reply).poses
    ] == cut
    gone, *shown = node.tubes(MSGS, HEADER, reply).markers
    assert gone.action == Marker.DELETEALL
    assert [(one.id, len(one.points)) for one in shown] == [(0, 33), (1, 33), (2, 33)]


def test_a_direction_against_x_is_half_a_turn(node: ModuleType) -> None:
    for direction in ([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -0.6, 0.8]):
        pose = node.pose_at(MSGS, [0.1, 0.2, 0.3], direction)
        assert turned(pose.orientation) == pytest.approx(direction, abs=1e-6)


def test_a_frame_that_fails_is_an_error(node: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    text = b'{"captures": [], "failures": [{"message": "no depth"}]}'
    monkeypatch.setattr(node.urllib.request, "urlopen", lambda *_, **__: io.BytesIO(text))
    with pytest.raises(ValueError, match="no depth"):
        node.ask("http://127.0.0.1:8600", {"color": COLOR, "depth": DEPTH, "matrix": np.eye(3)})


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
