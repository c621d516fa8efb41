"""Networks that give the same arrays, whatever they see."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.arrays import Numbers
from cucumbervision.networks.registry import Model, ModelFile, Registry, file_sha256, load_registry


def constant_network(
    *outputs: Numbers,
    props: Mapping[str, object] | None = None,
    shape: tuple[int | str, ...] = (1, 3, 64, 64),
    image: str = "images",
    names: Sequence[str] = (),
) -> bytes:
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    nodes = [
        helper.make_node("ReduceMax", [image], ["most"], keepdims=0),
        helper.make_node("Mul", ["most", "zero"], ["nothing"]),
    ]
    constants, values = [onnx.numpy_helper.from_array(np.float32(0), "zero")], []
    for i, array in enumerate(outputs):
        name = names[i] if names else f"output{i}"
        constants.append(onnx.numpy_helper.from_array(array.astype(np.float32), f"{name} fixed"))
        nodes.append(helper.make_node("Add", [f"{name} fixed", "nothing"], [name]))
        values.append(helper.make_tensor_value_info(name, kind, array.shape))
    images = [helper.make_tensor_value_info(image, kind, shape)]
    graph = helper.make_graph(nodes, "g", images, values, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {name: str(value) for name, value in (props or {}).items()})
    return bytes(model.SerializeToString())


def registry_of(folder: Path, *models: Model, **files: Path) -> Registry:
    """A registry of some of the package's models, and of embedded networks by their tasks."""
    weights = folder / "weights"
    weights.mkdir(exist_ok=True)
    package, shipped = load_registry(), list(models)
    for model in models:
        for path in package.resolve(model.name).values():
            (weights / path.name).symlink_to(path)
    for task, file in files.items():
        path = Path(shutil.copyfile(file, weights / f"tiny-{task}.onnx"))
        part = ModelFile("network", path.name, file_sha256(path), path.stat().st_size)
        shipped.append(Model(f"tiny-{task}", task, "CC0-1.0", "t", "o", (part,), embedded=True))
    return Registry(tuple(shipped), weights, folder / "user")
