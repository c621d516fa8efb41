"""Choose the runtime of a network, and load it: ONNX Runtime or OpenVINO."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Mapping
from pathlib import Path

from cucumbervision.errors import ModelError
from cucumbervision.perception.network import Network
from cucumbervision.perception.onnx_file import external_files, has_loop
from cucumbervision.perception.onnx_runtime import check_graph, open_with_onnxruntime
from cucumbervision.perception.openvino_runtime import open_with_openvino

CARD_RUNTIMES = ("cuda", "tensorrt")
RUNTIMES = ("auto", "onnxruntime", "openvino", *CARD_RUNTIMES)

_log = logging.getLogger("cucumbervision")
_most_threads: int | None = None


def limit_threads(threads: int | None) -> None:
    """Limit the threads of all networks loaded later in this process."""
    global _most_threads
    _most_threads = threads


def open_network(
    path: Path | str | bytes,
    runtime: str = "auto",
    *,
    full_precision: bool = False,
    name: str = "",
    verified: bool = False,
) -> Network:
    """Load an ONNX file.

    Parameters
    ----------
    path : Path, str or bytes
        The file, or its content.
    runtime : str
        'onnxruntime', 'openvino', 'cuda' or 'tensorrt' (ONNX Runtime's providers), or 'auto':
        OpenVINO (faster on a CPU) if it is installed and loads the file, otherwise ONNX Runtime.
    full_precision : bool
        Compute in float32 for reproducible results; otherwise OpenVINO uses bfloat16 where the CPU
        supports it, CUDA uses TF32, and TensorRT half precision.
    name : str
        Name in errors of a network given as bytes.
    verified : bool
        Whether its hash was verified. Other files are first checked by ONNX Runtime, which rejects
        a broken graph: OpenVINO crashes at a node without its inputs.

    Returns
    -------
    Network

    Raises
    ------
    ModelError
        If the file is missing or not a network, the runtime unknown, or its provider not available.
    MissingExtraError
        If 'openvino' is asked for and not installed.
    """
    source = (name or "network in memory") if isinstance(path, bytes) else str(path)
    if runtime not in RUNTIMES:
        raise ModelError(
            f"no runtime is called {runtime!r}", remedy=f"choose one of {', '.join(RUNTIMES)}"
        )
    if not isinstance(path, bytes):
        path = Path(path)
        if not path.is_file():
            raise ModelError("there is no such file", source=source, remedy="check the path")
    loops = False
    if not verified:
        loops = _inspected(path if isinstance(path, bytes) else path.read_bytes(), source)
    if loops and runtime == "openvino":
        raise ModelError(
            "holds a loop, which OpenVINO cannot end if it goes on for ever",
            source=source,
            remedy="choose the runtime onnxruntime",
        )
    for_openvino = (
        runtime in ("auto", "openvino") and not loops and importlib.util.find_spec("openvino")
    )
    if for_openvino and not verified:
        check_graph(path, source)
    if runtime == "openvino":
        return _by_openvino({source: path}, full_precision)[0]
    if runtime != "auto" or not for_openvino:
        chosen = "onnxruntime" if runtime == "auto" else runtime
        return open_with_onnxruntime(
            path,
            source,
            chosen,
            full_precision=full_precision,
            threads=_most_threads,
            loops=loops,
        )
    try:
        return _by_openvino({source: path}, full_precision)[0]
    except ModelError as error:
        fault = error.message
    network = open_with_onnxruntime(
        path,
        source,
        "onnxruntime",
        full_precision=full_precision,
        threads=_most_threads,
        why="; OpenVINO cannot load it",
    )
    _log.info("%s: %s, so ONNX Runtime runs it", source, fault)
    return network


def _by_openvino(files: Mapping[str, Path | bytes], full_precision: bool) -> list[Network]:
    return open_with_openvino(files, full_precision=full_precision, threads=_most_threads)


def _inspected(network: bytes, source: str) -> bool:
    """Reject weights in another file; return whether a network contains a loop."""
    try:
        outside, loops = external_files(network), has_loop(network)
    except ValueError:  # the runtimes reject files that are not ONNX
        return False
    if outside:
        raise ModelError(
            "its weights are in another file, which its hash does not cover",
            source=source,
            remedy="save it as one file: onnx.save(onnx.load(FILE), NEW_FILE)",
        )
    return loops


def runtime_for_batches(runtime: str) -> str:
    """Return the runtime of a network whose batches differ in size from picture to picture.

    TensorRT would compile for minutes at each new size, so CUDA runs it. On a processor ONNX
    Runtime is the fastest for small networks.

    Examples
    --------
    >>> [runtime_for_batches(asked) for asked in ("tensorrt", "auto", "openvino")]
    ['cuda', 'onnxruntime', 'openvino']
    """
    return {"auto": "onnxruntime", "tensorrt": "cuda"}.get(runtime, runtime)
