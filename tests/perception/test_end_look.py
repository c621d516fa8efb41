from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import ModelError
from cucumbervision.perception.end_look import (
    END_PX,
    PLANES,
    EndCrop,
    EndLooker,
    end_crop,
    looked_at,
)
from cucumbervision.perception.registry import load_registry

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
RADIUS_M, DISTANCE_M = 0.02, 0.6
GREEN, WALL, LEAF = (40, 140, 40), (90, 90, 90), (200, 200, 30)


def scene(
    angle_deg: float, tip_px: tuple[float, float] = (320.0, 240.0)
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_], NDArray[np.float64]]:
    """Draw a fruit of 12 cm that ends at `tip_px` in a direction, and a leaf beyond that end."""
    ahead = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    v, u = np.mgrid[:480, :640].astype(float)
    along = (u - tip_px[0]) * ahead[0] + (v - tip_px[1]) * ahead[1]
    aside = -(u - tip_px[0]) * ahead[1] + (v - tip_px[1]) * ahead[0]
    mask = (along <= 0) & (along > -120) & (np.abs(aside) <= 20)
    leaf = (along > 40) & (along < 70) & (np.abs(aside) <= 60)
    color = np.full((480, 640, 3), WALL, np.uint8)
    color[mask], color[leaf] = GREEN, LEAF
    depth = np.full((480, 640), 1.0, np.float32)
    depth[mask], depth[leaf] = DISTANCE_M - RADIUS_M, DISTANCE_M - 0.04
    # At 0.6 m a pixel is a millimetre.
    pixels = np.array(tip_px) - np.linspace(0, 120, 13)[:, None] * ahead
    axis = np.column_stack([(pixels - (320.0, 240.0)) / 1000, np.full(13, DISTANCE_M)])
    return color, depth, mask, axis


@pytest.mark.parametrize("angle", [0.0, 40.0, 90.0, 200.0, 305.0])
def test_the_fruit_comes_from_the_left_whatever_its_direction(angle: float) -> None:
    color, depth, mask, axis = scene(angle)
    planes = end_crop(color, depth, mask, CAMERA, axis, 2 * RADIUS_M).planes.astype(int)
    # A side of 160 px on 64: 2.5 px each; the radius is 8 of the crop's pixels.
    middle = planes[END_PX // 2]
    assert (middle[2:30, 5] == 255).all()
    assert (middle[34:, 5] == 0).all()
    assert np.abs(middle[4:28, :3] - GREEN).max() < 12
    assert np.abs(middle[50:58, :3] - LEAF).max() < 12
    rows = np.flatnonzero(planes[:, 16, 5])
    assert len(rows) == pytest.approx(16, abs=2)
    # The surface is the reference; the leaf is one radius nearer, the wall far behind.
    assert np.abs(middle[4:28, 3] - 128).max() <= 2
    assert np.abs(middle[50:58, 3] - (127.5 - 127.5 / 4)).max() <= 2
    assert (middle[36:44, 3] == 255).all()


def test_what_has_no_reading_and_what_lies_outside_is_told() -> None:
    color, depth, mask, axis = scene(0, tip_px=(620.0, 240.0))
    depth[:, :560] = 0
    planes = end_crop(color, depth, mask, CAMERA, axis, 2 * RADIUS_M).planes
    middle = planes[END_PX // 2]
    assert (middle[:6, 3:5] == (128, 0)).all()  # the fruit, without readings
    assert (middle[10:28, 4] == 255).all()
    beyond = middle[42:]  # 25 px beyond the end, where the picture ends after 19
    assert (beyond == (114, 114, 114, 128, 0, 0)).all()


def test_shape_is_length_and_radius() -> None:
    color, depth, mask, axis = scene(0)
    aspect, radius = end_crop(color, depth, mask, CAMERA, axis, 2 * RADIUS_M).shape
    assert np.exp(aspect) == pytest.approx(0.12 / 0.02)
    assert np.exp(radius) == pytest.approx(20.0)


def test_an_axis_along_the_view_and_a_speck_give_a_crop() -> None:
    color, depth, mask, axis = scene(0)
    along = np.column_stack([np.zeros((13, 2)), np.linspace(0.6, 0.72, 13)])
    for line, diameter in ((along, 0.04), (np.repeat(axis[:1], 3, axis=0), 0.04), (axis, 0.0)):
        assert end_crop(color, depth, mask, CAMERA, line, diameter).planes.shape[2] == PLANES


def look_network(path: Path, side: int = END_PX) -> Path:
    """Write a network whose first eight outputs are the crop's mean and whose last its rows' sum.

    The last is the mean of the upper half of the first plane, which mirroring changes.
    """
    shapes = {"crops": ("n", PLANES, side, side), "shapes": ("n", 2)}
    inputs = [helper.make_tensor_value_info(k, TensorProto.FLOAT, v) for k, v in shapes.items()]
    ends = [("starts", [0, 0]), ("stops", [1, side // 2]), ("axes", [1, 2])]
    constants = [helper.make_tensor(k, TensorProto.INT64, [2], v) for k, v in ends]
    nodes = [
        helper.make_node("Slice", ["crops", "starts", "stops", "axes"], ["upper"]),
        helper.make_node("ReduceMean", ["upper"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("ReduceMean", ["shapes"], ["shape"], axes=[1], keepdims=0),
        helper.make_node("Unsqueeze", ["mean", "last"], ["a"]),
        helper.make_node("Unsqueeze", ["shape", "last"], ["b"]),
        helper.make_node("Concat", ["a", *["b"] * 7, "a"], ["looks"], axis=1),
    ]
    constants.append(helper.make_tensor("last", TensorProto.INT64, [1], [1]))
    out = [helper.make_tensor_value_info("looks", TensorProto.FLOAT, ("n", 9))]
    model = helper.make_model(
        helper.make_graph(nodes, "g", inputs, out, constants),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=9,
    )
    onnx.save(model, path)
    return path


def test_all_ends_are_one_batch_and_each_is_the_mean_with_its_mirror_image(tmp_path: Path) -> None:
    looker = EndLooker(look_network(tmp_path / "look.onnx"))
    batches: list[int] = []
    network = looker._network
    compute = network.compute

    def counted(feeds: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        batches.append(len(feeds["crops"]))
        return compute(feeds)

    looker._network = replace(network, compute=counted)
    planes = np.zeros((END_PX, END_PX, PLANES), np.uint8)
    planes[: END_PX // 2, :, 0] = 255  # the upper half: the mean of it and its mirror is a half
    looks = looker.look([EndCrop(planes, (1.0, 3.0)), EndCrop(0 * planes, (0.0, 0.0))])
    assert batches == [4]
    first, second = looks
    expected = looked_at(np.array([0.5, *[2.0] * 7, 0.5]))
    assert first.stem == pytest.approx(expected.stem, abs=1e-6)
    assert first.covered == pytest.approx(expected.covered, abs=1e-6)
    assert second.stem == pytest.approx(0.5)
    assert looker.look([]) == []
    assert batches == [4]


def test_quantiles_never_cross_and_probabilities_are_one_together() -> None:
    look = looked_at(np.array([3.0, -1.0, 0.5, 1.0, -2.0, 0.0, 0.5, 4.0, 0.0]))
    assert list(look.missing) == sorted(look.missing)
    assert look.true + look.covered + look.running_on == pytest.approx(1.0)
    assert look.missing[-1] == pytest.approx(0.02 * np.sinh(4.0))


def test_another_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="not crops of ends"):
        EndLooker(load_registry().resolve("cucumber-ends")["network"])
    with pytest.raises(ModelError, match="train look"):
        EndLooker(look_network(tmp_path / "look.onnx", side=32))
