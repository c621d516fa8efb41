from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from cucumbervision.errors import ModelError
from cucumbervision.perception.ends import STRIP_PX, EndClassifier, orient

if TYPE_CHECKING:
    from pathlib import Path

Picture = NDArray[np.uint8]


def bar(angle_deg: float, length_px: float = 120.0) -> tuple[Picture, NDArray[np.float64]]:
    """Draw a bar that is blue at its first end and red at its last, and give five points on it."""
    v, u = np.mgrid[:240, :240] - 120.0
    ahead = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    along, aside = u * ahead[0] + v * ahead[1], -u * ahead[1] + v * ahead[0]
    picture = np.full((240, 240, 3), 90, np.uint8)
    inside = (np.abs(along) <= length_px / 2) & (np.abs(aside) <= length_px / 8)
    picture[inside & (along < 0)] = (20, 20, 220)
    picture[inside & (along >= 0)] = (220, 20, 20)
    points = 120.0 + np.linspace(-0.5, 0.5, 5)[:, None] * length_px * ahead
    return picture, points


@pytest.mark.parametrize("angle", [0.0, 35.0, 90.0, 200.0, 290.0])
@pytest.mark.parametrize("length", [40.0, 120.0, 180.0])
def test_a_fruit_is_laid_level_whatever_its_angle_and_size(angle: float, length: float) -> None:
    picture, points = bar(angle, length)
    strip = orient(picture, points)
    assert strip is not None
    assert strip.shape == (*STRIP_PX, 3)
    middle = strip[STRIP_PX[0] // 2].astype(int)
    # 0.25 of the length lies beyond either end: of 192 columns the fruit has 32 to 159.
    assert (middle[40:88, 2] > 180).all()
    assert (middle[104:152, 0] > 180).all()
    assert np.abs(middle[:24] - 90).max() < 30
    assert np.abs(middle[-24:] - 90).max() < 30
    turned = orient(picture, points[::-1])
    assert turned is not None
    assert np.abs(turned[::-1, ::-1].astype(int) - strip).mean() < 3


def test_what_is_no_line_is_left_out() -> None:
    picture, points = bar(0)
    assert orient(picture, np.repeat(points[:1], 5, axis=0)) is None
    assert orient(picture, np.full((5, 2), np.nan)) is None
    # One point twice is no fault, and points beyond the picture show grey.
    assert orient(picture, points[[0, 0, 1, 2, 4]]) is not None
    beyond = orient(picture, points + 500)
    assert beyond is not None


@pytest.fixture(scope="module")
def redness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that says: the stem is where it is redder, right less left."""
    weights = np.zeros((1, 3, *STRIP_PX), np.float32)
    half = STRIP_PX[1] // 2
    weights[0, 0, :, half:], weights[0, 0, :, :half] = 0.0025, -0.0025
    nodes = [
        helper.make_node("Conv", ["fruit", "weights"], ["far"]),
        helper.make_node("Flatten", ["far"], ["flat"]),
        helper.make_node("Squeeze", ["flat", "axes"], ["stem_right"]),
    ]
    graph = helper.make_graph(
        nodes,
        "ends",
        [helper.make_tensor_value_info("fruit", TensorProto.FLOAT, ["n", 3, *STRIP_PX])],
        [helper.make_tensor_value_info("stem_right", TensorProto.FLOAT, ["n"])],
        [
            onnx.numpy_helper.from_array(weights, "weights"),
            onnx.numpy_helper.from_array(np.array([1], np.int64), "axes"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    path = tmp_path_factory.mktemp("ends") / "ends.onnx"
    onnx.save(model, path)
    return path


def test_the_stem_is_told_whichever_way_the_points_came(redness: Path) -> None:
    classifier = EndClassifier(redness)
    picture, points = bar(120)
    ahead, nothing, back = classifier.log_odds(picture, [points, points[:1], points[::-1]])
    assert nothing is None
    assert ahead is not None
    assert ahead > np.log(9)
    assert back == pytest.approx(-ahead, abs=0.01)
    assert classifier.log_odds(picture, []) == []


def test_a_fruit_of_one_colour_is_unsure(redness: Path) -> None:
    grey = np.full((240, 240, 3), 90, np.uint8)
    (odds,) = EndClassifier(redness).log_odds(grey, [bar(0)[1]])
    assert odds == pytest.approx(0, abs=0.04)


def test_another_network_is_refused(tmp_path: Path) -> None:
    node = helper.make_node("Identity", ["x"], ["y"])
    shape = [1, 3, 64, 64]
    graph = helper.make_graph(
        [node],
        "other",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, shape)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(ModelError, match="laid level"):
        EndClassifier(tmp_path / "other.onnx")
