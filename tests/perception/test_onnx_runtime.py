from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.errors import ModelError
from cucumbervision.perception.runtime import open_network

onnx = pytest.importorskip("onnx")


@pytest.mark.parametrize("runtime", ["auto", "onnxruntime"])
def test_a_loop_that_never_ends_is_ended(runtime: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cucumbervision.perception.onnx_runtime._LONGEST_RUN_S", 1.0)
    helper, kind = onnx.helper, onnx.TensorProto
    numbers = [
        helper.make_tensor_value_info("i", kind.INT64, []),
        helper.make_tensor_value_info("go", kind.BOOL, []),
    ]
    step = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["on"]),
            helper.make_node("Sin", ["v"], ["w"]),
        ],
        "step",
        [*numbers, helper.make_tensor_value_info("v", kind.FLOAT, [1, 64])],
        [
            helper.make_tensor_value_info("on", kind.BOOL, []),
            helper.make_tensor_value_info("w", kind.FLOAT, [1, 64]),
        ],
    )
    often = onnx.numpy_helper.from_array(np.array(2**62, np.int64), "often")
    true = onnx.numpy_helper.from_array(np.array(True), "true")
    graph = helper.make_graph(
        [helper.make_node("Loop", ["often", "true", "a"], ["y"], body=step)],
        "g",
        [helper.make_tensor_value_info("a", kind.FLOAT, [1, 64])],
        [helper.make_tensor_value_info("y", kind.FLOAT, [1, 64])],
        [often, true],
    )
    opset = [helper.make_opsetid("", 17)]
    endless = helper.make_model(graph, opset_imports=opset, ir_version=9).SerializeToString()
    with pytest.raises(ModelError, match="choose the runtime onnxruntime"):
        open_network(endless, "openvino")
    network = open_network(endless, runtime)
    with pytest.raises(ModelError, match="the network fails on a"):
        network.run({"a": np.ones((1, 64), np.float32)})
