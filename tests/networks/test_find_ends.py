from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from cucumbervision.errors import ModelError
from cucumbervision.fruit.crops import END_PX, PLANES, EndCrop
from cucumbervision.networks.find import EndLooker, looked_at
from cucumbervision.networks.registry import load_registry

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.arrays import Array32


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

    def counted(feeds: dict[str, Array32]) -> list[Array32]:
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
        EndLooker(load_registry().resolve("cucumber-fruit")["network"])
    with pytest.raises(ModelError, match="train classifier look"):
        EndLooker(look_network(tmp_path / "look.onnx", side=32))
