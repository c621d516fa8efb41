"""OpenVINO, on the processor.

`import openvino` sends an event by default, through the package openvino_telemetry.
`import_openvino` disables that; no other module imports the library.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cucumbervision.errors import MissingExtraError
from cucumbervision.perception.network import Array, Network, TensorInfo, unreadable

# Two threads may each open a network.
_STARTING_OPENVINO = threading.RLock()


def import_openvino() -> Any:
    """Import OpenVINO with its telemetry off.

    OpenVINO falls back on a stub of its own where the package openvino_telemetry cannot be
    imported, so it is hidden while OpenVINO loads.

    Raises
    ------
    MissingExtraError
        If OpenVINO is not installed.
    """
    modules: dict[str, Any] = sys.modules
    with _STARTING_OPENVINO:
        before = modules.get("openvino_telemetry")
        modules["openvino_telemetry"] = None
        try:
            import openvino
        except ImportError as error:
            raise MissingExtraError("openvino", "openvino") from error
        finally:
            del modules["openvino_telemetry"]
            if before is not None:
                modules["openvino_telemetry"] = before
    return openvino


@lru_cache(maxsize=1)
def _openvino_core() -> Any:
    return import_openvino().Core()


def open_with_openvino(
    files: Mapping[str, Path | bytes], *, full_precision: bool, threads: int | None = None
) -> list[Network]:
    """Load networks with OpenVINO; they compile side by side, each mostly on one core.

    Parameters
    ----------
    files : mapping of str to Path or bytes
        Each file, or its content, by its name in errors.
    full_precision : bool
        As in `open_network`.
    threads : int, optional
        Most threads of one run.

    Raises
    ------
    ModelError
        If a file cannot be loaded.
    MissingExtraError
        If OpenVINO is not installed.
    """
    settings: dict[str, Any] = {"PERFORMANCE_HINT": "LATENCY"}
    if full_precision:
        settings["INFERENCE_PRECISION_HINT"] = "f32"
    if threads is not None:
        settings["INFERENCE_NUM_THREADS"] = threads
    # Nothing else meanwhile, against a deadlock between Python's lock (held while reading a
    # network's inputs) and OpenVINO's (held while compiling).
    with _STARTING_OPENVINO, ThreadPoolExecutor(len(files)) as pool:
        core = _openvino_core()
        try:
            models = [
                core.read_model(path if isinstance(path, bytes) else str(path))
                for path in files.values()
            ]
            metadata = [_openvino_metadata(model) for model in models]
            compiled = list(
                pool.map(lambda model: core.compile_model(model, "CPU", settings), models)
            )
            return [
                _openvino_network(network, data, source)
                for network, data, source in zip(compiled, metadata, files, strict=True)
            ]
        except Exception as error:
            raise unreadable(", ".join(files), "OpenVINO", error) from error


def _openvino_network(compiled: Any, metadata: Mapping[str, str], source: str) -> Network:
    precision = compiled.get_property("INFERENCE_PRECISION_HINT").to_string()
    request = compiled.create_infer_request()
    inputs = tuple(_openvino_info(i) for i in compiled.inputs)
    outputs = tuple(_openvino_info(o) for o in compiled.outputs)

    one_at_a_time = threading.Lock()

    def compute(feeds: dict[str, Array]) -> list[Array]:
        with one_at_a_time:
            request.infer(feeds, share_inputs=True)
            # Copy, since the next run overwrites the request's buffers.
            return [request.get_output_tensor(i).data.copy() for i in range(len(outputs))]

    return Network(
        inputs=inputs,
        outputs=outputs,
        metadata=MappingProxyType(dict(metadata)),
        runtime=f"openvino ({precision})",
        source=source,
        compute=compute,
    )


def _openvino_info(port: Any) -> TensorInfo:
    shape = tuple(d.get_length() if d.is_static else None for d in port.get_partial_shape())
    return TensorInfo(port.get_any_name(), shape, np.dtype(port.get_element_type().to_dtype()))


def _openvino_metadata(model: Any) -> dict[str, str]:
    """Return the ONNX file's custom metadata, which OpenVINO keeps as the model's 'framework'."""
    if not model.has_rt_info("framework"):
        return {}
    return {key: str(value) for key, value in model.get_rt_info("framework").value.items()}
