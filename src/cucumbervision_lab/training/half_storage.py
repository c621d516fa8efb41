"""Store an ONNX network's weights in half precision, and compute in float32 as before."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import onnx

__all__ = ["halve_storage"]

_SMALLEST = 1024  # fewer numbers than this stay as they are: they cost nothing


def halve_storage(network: onnx.ModelProto) -> None:
    """Replace float32 weights by float16 ones, each widened by a Cast; changes the network.

    Both runtimes do the Cast once, when they load the file. Tables beyond float16's range stay.

    Parameters
    ----------
    network : onnx.ModelProto
        Any network.
    """
    from onnx import TensorProto, helper, numpy_helper

    graph = network.graph
    casts = []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if tensor.data_type != TensorProto.FLOAT or values.size < _SMALLEST:
            continue
        if np.abs(values).max() > np.finfo(np.float16).max:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
