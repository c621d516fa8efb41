from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from cucumbervision.errors import ModelError
from cucumbervision.perception.network import Network, TensorInfo


def test_checking_a_large_output_takes_no_memory() -> None:
    output = np.ones((1, 4, 1000, 500), np.float32)
    info = TensorInfo("y", output.shape, output.dtype)
    network = Network((), (info,), {}, "onnxruntime", "a.onnx", lambda _: [output])
    tracemalloc.start()
    try:
        assert network.run({})["y"] is output
        assert tracemalloc.get_traced_memory()[1] < output.size / 10  # bytes
    finally:
        tracemalloc.stop()
    output[0, 3, 999, 499] = np.nan
    with pytest.raises(ModelError, match="numbers that are not finite"):
        network.run({})
