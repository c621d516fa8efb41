from __future__ import annotations

import importlib.util
import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.errors import MissingExtraError, ModelError
from cucumbervision.networks.runtime import Network, TensorInfo, _import_openvino, open_network

onnx = pytest.importorskip("onnx")

RUNTIMES = ("onnxruntime", "openvino")


def need(runtime: str) -> None:
    if runtime == "openvino":
        pytest.importorskip("openvino")


def graph(nodes: list[Any], inputs: dict[str, Any], outputs: dict[str, Any], **how: Any) -> bytes:
    """Return a network: nodes as (operation, inputs, outputs), tensors as (shape, type)."""
    helper = onnx.helper
    made = [helper.make_node(*node[:3], **(node[3] if node[3:] else {})) for node in nodes]
    infos = [
        [helper.make_tensor_value_info(name, kind, shape) for name, (shape, kind) in part.items()]
        for part in (inputs, outputs)
    ]
    constants = [onnx.numpy_helper.from_array(value, name) for name, value in how.items()]
    whole = helper.make_graph(made, "g", *infos, constants)
    model = helper.make_model(whole, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {"names": "{0: 'cucumber'}", "stride": "32"})
    return bytes(model.SerializeToString())


FLOAT, HALF = onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16


def scaled_sum(half: bool = False, free: bool = True) -> bytes:
    """Give a network y = 2.5 a + b, its factor stored in half precision where asked."""
    tensor = [1, "n" if free else 3], FLOAT
    nodes = [
        ("Cast", ["k"], ["kf"], {"to": FLOAT}),
        ("Mul", ["a", "kf"], ["ka"]),
        ("Add", ["ka", "b"], ["y"]),
    ]
    factor = np.array([2.5], np.float16 if half else np.float32)
    return graph(nodes, {"a": tensor, "b": tensor}, {"y": tensor}, k=factor)


def float16_relu() -> bytes:
    """Give a network whose input and output are float16."""
    return graph([("Relu", ["x"], ["y"])], {"x": ([4], HALF)}, {"y": ([4], HALF)})


def determinant() -> bytes:
    """Give a network that ONNX Runtime loads and OpenVINO has no rule for."""
    return graph([("Det", ["x"], ["y"])], {"x": ([2, 2], FLOAT)}, {"y": (None, FLOAT)})


def run(network: Network) -> list[float]:
    feeds = {"a": np.array([[1.0, 2, 3]]), "b": np.array([[10, 20, 30]])}
    return [float(v) for v in network.run(feeds)["y"][0]]


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("half", [False, True])
def test_runs_full_and_half_stored_weights(runtime: str, half: bool) -> None:
    need(runtime)
    network = open_network(scaled_sum(half), runtime, full_precision=True)
    assert run(network) == [12.5, 25.0, 37.5]
    assert (
        network.runtime
        == {"onnxruntime": "onnxruntime (cpu)", "openvino": "openvino (f32)"}[runtime]
    )


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_tells_names_shapes_and_metadata(runtime: str) -> None:
    need(runtime)
    network = open_network(scaled_sum(), runtime)
    single = np.dtype(np.float32)
    assert [(i.name, i.shape, i.dtype) for i in network.inputs] == [
        ("a", (1, None), single),
        ("b", (1, None), single),
    ]
    assert [o.name for o in network.outputs] == ["y"]
    assert dict(network.metadata) == {"names": "{0: 'cucumber'}", "stride": "32"}


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_half_precision_inputs_are_narrowed_and_outputs_widened(runtime: str) -> None:
    need(runtime)
    network = open_network(float16_relu(), runtime)
    out = network.run({"x": np.array([-1.0, 0.5, 2, 3], np.float32)})["y"]
    assert out.dtype == np.float32
    assert out.tolist() == [0.0, 0.5, 2.0, 3.0]


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_outputs_outlive_the_next_run(runtime: str) -> None:
    need(runtime)
    network = open_network(float16_relu(), runtime)
    first = network.run({"x": np.full(4, 1.0)})["y"]
    network.run({"x": np.full(4, 7.0)})
    assert first.tolist() == [1.0] * 4


@pytest.mark.parametrize("runtime", ["auto", *RUNTIMES])
def test_truncated_file_is_named(runtime: str, tmp_path: Path) -> None:
    need(runtime)
    path = tmp_path / "cut.onnx"
    path.write_bytes(scaled_sum()[:60])
    with pytest.raises(ModelError, match=r"cut\.onnx: .*cannot load it"):
        open_network(path, runtime)


@pytest.mark.parametrize("content", [b"PK\x03\x04", b"", b"<xml/>"])
def test_other_files_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.onnx"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"cannot load it .*; give a complete ONNX file"):
        open_network(path)


def test_weights_in_another_file_are_refused(tmp_path: Path) -> None:
    """No hash would notice that the other file was changed."""
    model, how = onnx.load_from_string(scaled_sum()), {"location": "w.bin", "size_threshold": 0}
    onnx.save(model, tmp_path / "net.onnx", save_as_external_data=True, **how)
    assert (tmp_path / "w.bin").exists()
    with pytest.raises(ModelError, match=r"net\.onnx: .*cannot load it"):
        open_network(tmp_path / "net.onnx")


def test_missing_file_and_unknown_runtime(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such file"):
        open_network(tmp_path / "none.onnx")
    with pytest.raises(ModelError, match="choose one of auto, onnxruntime"):
        open_network(scaled_sum(), "tflite")


@pytest.mark.parametrize(
    ("runtime", "provider"),
    [("cuda", "CUDAExecutionProvider"), ("tensorrt", "TensorrtExecutionProvider")],
)
def test_missing_provider_is_named(runtime: str, provider: str) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    if provider in onnxruntime.get_available_providers():
        pytest.skip("this build has the provider")
    with pytest.raises(ModelError, match=f"no {provider} here; install onnxruntime-gpu"):
        open_network(scaled_sum(), runtime)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_wrong_feeds_are_named(runtime: str) -> None:
    need(runtime)
    network = open_network(scaled_sum(free=False), runtime, name="tiny")
    with pytest.raises(ModelError, match="tiny: the network takes a, b, not a"):
        network.run({"a": np.zeros((1, 3))})
    with pytest.raises(ModelError, match=r"tiny: the network fails on a \(1, 4\)"):
        network.run({"a": np.zeros((1, 4)), "b": np.zeros((1, 4))})


def test_auto_takes_openvino_first() -> None:
    pytest.importorskip("openvino")
    assert open_network(scaled_sum(), "auto").runtime.startswith("openvino")


def test_auto_steps_down_and_says_why(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("openvino")
    with pytest.raises(ModelError, match=r"OpenVINO cannot load it .*choose the runtime auto"):
        open_network(determinant(), "openvino")
    with caplog.at_level(logging.INFO, "cucumbervision"):
        network = open_network(determinant(), "auto", name="det")
    assert network.runtime == "onnxruntime (cpu; OpenVINO cannot load it)"
    assert "det: OpenVINO cannot load it" in caplog.text
    assert network.run({"x": np.diag([2.0, 4.0])})["y"] == 8


def printed_alone(code: str, network: Path, home: Path) -> str:
    """Return what a process of its own prints that is given a network."""
    done = subprocess.run(
        [sys.executable, "-c", code, str(network)],
        env={"HOME": str(home), "PYTHONPATH": str(Path(__file__).parents[2] / "src")},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_nothing_is_sent_or_stored(tmp_path: Path) -> None:
    """Load both runtimes in a fresh process with an empty home, and count what they leave."""
    (tmp_path / "tiny.onnx").write_bytes(scaled_sum())
    code = (
        "import importlib.util, socket, sys\n"
        "def refuse(*a, **k): raise SystemExit('a connection was tried')\n"
        "socket.socket.connect = socket.getaddrinfo = refuse\n"
        "from cucumbervision.networks.runtime import open_network\n"
        "for name in ('onnxruntime', 'openvino'):\n"
        "    if importlib.util.find_spec(name): open_network(sys.argv[1], name)\n"
        "print([m for m in sys.modules if m.startswith('openvino_telemetry')])\n"
    )
    home = tmp_path / "home"
    home.mkdir()
    assert printed_alone(code, tmp_path / "tiny.onnx", home) == "[]"
    assert list(home.rglob("*")) == []


@pytest.mark.skipif(importlib.util.find_spec("openvino") is None, reason="needs OpenVINO")
def test_two_threads_may_load_the_first_networks_of_a_process(tmp_path: Path) -> None:
    """OpenVINO is imported with a stand-in for its telemetry, which two must not do at once."""
    (tmp_path / "tiny.onnx").write_bytes(scaled_sum())
    code = (
        "import sys, threading\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from cucumbervision.networks.runtime import open_network\n"
        "together = threading.Barrier(4)\n"
        "def load(_):\n"
        "    together.wait()\n"
        "    return open_network(sys.argv[1], 'openvino').runtime\n"
        "print(len(list(ThreadPoolExecutor(4).map(load, range(4)))))\n"
    )
    assert printed_alone(code, tmp_path / "tiny.onnx", tmp_path) == "4"


def test_without_openvino_auto_takes_onnx_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    _import_openvino.cache_clear()
    assert open_network(scaled_sum(), "auto").runtime == "onnxruntime (cpu)"
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[openvino\]"):
        open_network(scaled_sum(), "openvino")


def test_an_output_that_is_not_finite_is_refused() -> None:
    output = np.ones((1, 4, 10, 5), np.float32)
    info = TensorInfo("y", output.shape, output.dtype)
    network = Network((), (info,), {}, "onnxruntime", "a.onnx", lambda _: [output])
    assert network.run({})["y"] is output
    output[0, 3, 9, 4] = np.nan
    with pytest.raises(ModelError, match="numbers that are not finite"):
        network.run({})
