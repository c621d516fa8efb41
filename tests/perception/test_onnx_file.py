"""Networks with files outside themselves, made by ONNX's own library."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cucumbervision.perception.onnx_file import external_files, has_loop

onnx = pytest.importorskip("onnx")


def tensor(name: str, location: str | None = None, values: int = 4) -> Any:
    stored = onnx.numpy_helper.from_array(np.ones(values, np.float32), name)
    if location is not None:
        onnx.external_data_helper.set_external_data(stored, location)
        stored.ClearField("raw_data")
        stored.data_location = onnx.TensorProto.EXTERNAL
    return stored


def network(graph_tensors: list[Any], node: Any = None) -> Any:
    helper, kind = onnx.helper, onnx.TensorProto
    ends = [helper.make_tensor_value_info(n, kind.FLOAT, [4]) for n in ("x", "y")]
    nodes = [node or helper.make_node("Identity", ["x"], ["y"])]
    return helper.make_model(helper.make_graph(nodes, "g", ends[:1], ends[1:], graph_tensors))


def test_weights_and_attributes_of_nested_graphs_are_looked_at() -> None:
    inside = network([tensor("w")]).SerializeToString()
    assert external_files(inside) == []
    assert not has_loop(inside)
    outside = network([tensor("w", "w.bin")]).SerializeToString()
    assert [name for name in external_files(outside) if name] == ["w.bin"]
    helper = onnx.helper
    branch = helper.make_graph(
        [helper.make_node("Constant", [], ["z"], value=tensor("c", "/etc/passwd"))],
        "then",
        [],
        [helper.make_tensor_value_info("z", onnx.TensorProto.FLOAT, [4])],
    )
    loop = helper.make_node("Loop", ["", "", "x"], ["y"], body=branch)
    assert has_loop(network([], loop).SerializeToString())
    node = helper.make_node("If", ["x"], ["y"], then_branch=branch, else_branch=branch)
    nested = network([], node).SerializeToString()
    assert {name for name in external_files(nested) if name} == {"/etc/passwd"}


def test_bytes_that_look_like_a_location_within_weights_are_weights() -> None:
    weights = np.frombuffer(b"\x0a\x08location\x12\x05w.bin\x00" * 4, np.uint8)
    model = network([onnx.numpy_helper.from_array(weights, "w")])
    assert external_files(model.SerializeToString()) == []


@pytest.mark.parametrize("damage", [b"\xff" * 12, b"\x3a\x7f", b"\x3b\x01"])
def test_what_is_no_protocol_buffer_is_told(damage: bytes) -> None:
    with pytest.raises(ValueError, match=r"cut short|no protocol buffer"):
        external_files(damage)
