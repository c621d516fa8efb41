"""ONNX Runtime, on the processor and on a graphics card.

It sends telemetry by default: version 1.29 and later keeps a device id and a store of events under
the user's cache folder and uploads them. `import_onnxruntime` disables that before anything is
loaded; no other module imports the library.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.perception.card import Card, engine_folder, provider_options
from cucumbervision.perception.network import Array, Network, TensorInfo, unreadable

_PROVIDERS = {
    "onnxruntime": ("CPUExecutionProvider",),
    "cuda": ("CUDAExecutionProvider", "CPUExecutionProvider"),
    "tensorrt": ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"),
}
_PRECISIONS = {  # by whether it is to be full
    "onnxruntime": ("cpu", "cpu"),
    "cuda": ("cuda, tf32", "cuda, f32"),
    "tensorrt": ("tensorrt, f16", "tensorrt, f32"),
}
_CARD_MEMORY = "cuda"  # tests, which have no card, take the processor's
_GPU_REMEDY = "install onnxruntime-gpu in place of onnxruntime, or choose the runtime auto"
_ONNX_FLOATS = {"float": "float32", "double": "float64"}  # other types have the names of NumPy
_LONGEST_RUN_S = (
    300.0  # SAM takes 10 s on a slow processor; a network with a loop may run without end
)


def import_onnxruntime() -> Any:
    """Import ONNX Runtime with its telemetry off.

    The variable must be set before the library initialises (ONNX Runtime, `docs/Privacy.md`);
    early builds read the other name.
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    os.environ["ORT_TELEMETRY_DISABLED"] = "1"
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    onnxruntime.set_default_logger_severity(4)
    return onnxruntime


def check_graph(path: Path | bytes, source: str) -> None:
    """Raise if ONNX Runtime rejects the graph; nothing is optimised or run."""
    ort = import_onnxruntime()
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.add_session_config_entry("session.disable_prepacking", "1")
    try:
        ort.InferenceSession(
            path if isinstance(path, bytes) else str(path),
            options,
            providers=list(_PROVIDERS["onnxruntime"]),
        )
    # Its classes derive from Exception alone.
    except Exception as error:
        raise unreadable(source, "ONNX Runtime", error) from error


def open_with_onnxruntime(
    path: Path | bytes,
    source: str,
    runtime: str,
    *,
    full_precision: bool,
    threads: int | None = None,
    loops: bool = False,
    why: str = "",
) -> Network:
    """Load a network with ONNX Runtime.

    Parameters
    ----------
    path : Path or bytes
        The file, or its content.
    source : str
        Its name in errors.
    runtime : str
        'onnxruntime', 'cuda' or 'tensorrt'.
    full_precision : bool
        As in `open_network`.
    threads : int, optional
        Most threads of one run.
    loops : bool
        Whether the network contains a loop, so that a run needs a time limit.
    why : str
        Why another runtime does not run it, for `Network.runtime`.

    Raises
    ------
    ModelError
        If the file is not a network, or the runtime's provider is not available.
    """
    ort = import_onnxruntime()
    wanted_providers = _PROVIDERS[runtime]
    if wanted_providers[0] not in ort.get_available_providers():
        raise ModelError(f"ONNX Runtime has no {wanted_providers[0]} here", remedy=_GPU_REMEDY)
    options = ort.SessionOptions()
    options.log_severity_level = 4
    # Otherwise its threads spin for 30 ms after each run and slow the rest down.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    if threads is not None:
        options.intra_op_num_threads = threads
    engines = None
    if runtime == "tensorrt":
        engines = engine_folder(path, full_precision=full_precision)
    providers = [
        (p, provider_options(p, full_precision=full_precision, engines=engines))
        for p in wanted_providers
        if p in ort.get_available_providers()
    ]
    try:
        session = ort.InferenceSession(
            path if isinstance(path, bytes) else str(path), options, providers=providers
        )
        inputs = tuple(_onnx_info(i) for i in session.get_inputs())
        outputs = tuple(_onnx_info(o) for o in session.get_outputs())
        metadata = dict(session.get_modelmeta().custom_metadata_map)
    # Its classes derive from Exception alone.
    except Exception as error:
        raise unreadable(source, "ONNX Runtime", error) from error
    if wanted_providers[0] not in session.get_providers():
        raise ModelError(f"{wanted_providers[0]} does not start", source=source, remedy=_GPU_REMEDY)
    names = [o.name for o in outputs]
    card = None if loops or runtime == "onnxruntime" else _card(ort, session, names)
    compute: Callable[..., list[Array]] = partial(session.run, names)
    if loops:
        compute = partial(_run_for, _LONGEST_RUN_S, ort, session, names)
    return Network(
        inputs=inputs,
        outputs=outputs,
        metadata=MappingProxyType(metadata),
        runtime=f"onnxruntime ({_PRECISIONS[runtime][full_precision]}{why})",
        source=source,
        compute=compute if card is None else card.run,
        card=card,
    )


def _card(ort: Any, session: Any, names: list[str]) -> Card:
    providers = [
        (p, provider_options(p, full_precision=True))
        for p in _PROVIDERS["cuda"]
        if p in ort.get_available_providers()
    ]

    def open_piece(content: bytes) -> Any:
        options = ort.SessionOptions()
        options.log_severity_level = 4
        return ort.InferenceSession(content, options, providers=providers)

    return Card(session, names, open_piece, ort, _CARD_MEMORY)


def _run_for(
    longest_s: float, ort: Any, session: Any, names: list[str], feeds: dict[str, Array]
) -> list[Array]:
    """Run a session with a time limit, because a loop in a network may run without end."""
    settings = ort.RunOptions()
    timer = threading.Timer(longest_s, setattr, (settings, "terminate", True))
    timer.daemon = True
    timer.start()
    try:
        outputs: list[Array] = session.run(names, feeds, settings)
    finally:
        timer.cancel()
    return outputs


def _onnx_info(arg: Any) -> TensorInfo:
    shape = tuple(n if isinstance(n, int) else None for n in arg.shape)
    kind = arg.type.removeprefix("tensor(").removesuffix(")")
    kind = _ONNX_FLOATS.get(kind, kind)
    return TensorInfo(arg.name, shape, np.dtype(kind if kind in np.sctypeDict else "object"))
