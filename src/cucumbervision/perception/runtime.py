"""One interface to ONNX Runtime and OpenVINO: load a network and run it.

Both runtimes send telemetry by default: `import openvino` sends an event through the package
openvino_telemetry, and ONNX Runtime 1.29 and later keeps a device id and a store of events under
the user's cache folder and uploads them. `import_onnxruntime` and `import_openvino` disable it
before anything is loaded; no other module imports the two.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from cucumbervision.errors import MissingExtraError, ModelError
from cucumbervision.perception.card import (
    Card,
    CardArray,
    Feed,
    Levels,
    engine_folder,
    provider_options,
)
from cucumbervision.perception.onnx_file import external_files, has_loop

CARD_RUNTIMES = ("cuda", "tensorrt")
RUNTIMES = ("auto", "onnxruntime", "openvino", *CARD_RUNTIMES)

Array: TypeAlias = np.ndarray[Any, np.dtype[Any]]

_log = logging.getLogger("cucumbervision")

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
# Two threads may each open a network.
_STARTING_OPENVINO = threading.RLock()
_GPU_REMEDY = "install onnxruntime-gpu in place of onnxruntime, or choose the runtime auto"
_ONNX_FLOATS = {"float": "float32", "double": "float64"}  # other types have the names of NumPy


@dataclass(frozen=True)
class TensorInfo:
    """Name, shape and dtype of one input or output.

    Parameters
    ----------
    name : str
        The name in the file.
    shape : tuple of int or None
        None where the size is free.
    dtype : numpy.dtype
        Element type.
    """

    name: str
    shape: tuple[int | None, ...]
    dtype: np.dtype[Any]


@dataclass(frozen=True, eq=False)
class Network:
    """A loaded network; `open_network` makes it.

    Parameters
    ----------
    inputs, outputs : tuple of TensorInfo
        In the file's order.
    metadata : mapping of str to str
        The file's custom metadata (Ultralytics stores names, imgsz, task, stride, kpt_shape).
    runtime : str
        The runtime, with precision or provider; with the reason if 'auto' fell back to another.
    source : str
        The file, for errors.
    compute : callable
        The runtime's own call, from arrays by name to arrays in the order of `outputs`.
    card : Card, optional
        What computes on a graphics card; `compute` is its `run`.
    """

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    metadata: Mapping[str, str]
    runtime: str
    source: str
    compute: Callable[..., list[Array]]
    card: Card | None = None

    def run(self, feeds: Mapping[str, Feed], kept: Collection[str] = ()) -> dict[str, Any]:
        """Run the network once.

        Parameters
        ----------
        feeds : mapping of str to ndarray, Levels or CardArray
            Every input by name; values are converted to the input's dtype. Levels become numbers on
            the card, if there is one.
        kept : collection of str
            Outputs that stay on the card, if there is one: as `CardArray`.

        Returns
        -------
        dict of str to ndarray
            Every output by name; half-precision outputs are widened to float32.

        Raises
        ------
        ModelError
            If an input is missing or unknown, the network cannot take the shapes, or an output is
            not finite.
        """
        if set(feeds) != {i.name for i in self.inputs}:
            raise ModelError(
                f"the network takes {', '.join(i.name for i in self.inputs)}, "
                f"not {', '.join(feeds) or 'nothing'}",
                source=self.source,
                remedy="name a network of the right kind",
            )
        arrays = {i.name: self._fed(feeds[i.name], i.dtype) for i in self.inputs}
        try:
            outputs = self.compute(arrays) if self.card is None else self.compute(arrays, kept)
        # The two runtimes raise their own classes and plain RuntimeError alike.
        except Exception as error:
            sizes = ", ".join(f"{name} {_size(array)}" for name, array in arrays.items())
            raise ModelError(
                f"the network fails on {sizes}: {_first_line(error)}",
                source=self.source,
                remedy="give pictures of the size that it was exported for",
            ) from error
        return {
            info.name: array if isinstance(array, CardArray) else self._checked(info.name, array)
            for info, array in zip(self.outputs, outputs, strict=True)
        }

    def mixed(self, name: str, kept: CardArray, weights: Array) -> Array:
        """Return the weighted sums of an output (1, C, h, w) that stayed on the card, (N, h, w)."""
        assert self.card is not None
        return self._checked(name, self.card.mixed(kept, weights))

    def _fed(self, feed: Feed, dtype: np.dtype[Any]) -> Feed:
        if isinstance(feed, CardArray) and self.card is None:
            feed = feed.numpy()
        if isinstance(feed, Levels) and (self.card is None or dtype != np.float32):
            feed = feed.planes()
        return np.ascontiguousarray(feed, dtype) if isinstance(feed, np.ndarray) else feed

    def _checked(self, name: str, array: Array) -> Array:
        # The extremes show what is not finite, and need no memory beside that of a large output.
        extremes = (array.min(), array.max()) if array.dtype.kind == "f" and array.size else ()
        if not np.isfinite(extremes).all():
            raise ModelError(
                f"the network's output {name!r} has numbers that are not finite",
                source=self.source,
                remedy="export it again; half precision may overflow",
            )
        return array.astype(np.float32) if array.dtype == np.float16 else array


def _size(feed: Feed) -> tuple[int, ...]:
    if isinstance(feed, CardArray):
        return tuple(feed.value.shape())
    return feed.pixels.shape if isinstance(feed, Levels) else feed.shape


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
    begun = None
    if not isinstance(path, bytes):
        begun = _begun.pop(((Path(path),), runtime, full_precision), None)
    if begun is not None:
        return begun.result()[0]
    return _open_alone(path, runtime, full_precision, name=name, verified=verified)


def _open_alone(
    path: Path | str | bytes,
    runtime: str,
    full_precision: bool,
    *,
    name: str = "",
    verified: bool = False,
) -> Network:
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
        _check_graph(path, source)
    if runtime == "openvino":
        return _open_openvino({source: path}, full_precision)[0]
    if runtime != "auto" or not for_openvino:
        chosen = "onnxruntime" if runtime == "auto" else runtime
        return _open_onnxruntime(path, source, chosen, full_precision, loops=loops)
    try:
        return _open_openvino({source: path}, full_precision)[0]
    except ModelError as error:
        fault = error.message
    why = "; OpenVINO cannot load it"
    network = _open_onnxruntime(path, source, "onnxruntime", full_precision, why)
    _log.info("%s: %s, so ONNX Runtime runs it", source, fault)
    return network


# Two: while a large network compiles, small ones are loaded in turn.
_loading = ThreadPoolExecutor(2, thread_name_prefix="load networks")
_begun: dict[tuple[tuple[Path, ...], str, bool], Future[list[Network]]] = {}


def begin_networks(
    paths: Sequence[Path], runtime: str = "auto", *, full_precision: bool = False
) -> None:
    """Begin in a thread what `open_networks` does, which then waits for it; so does `open_network`.

    A runtime compiles without Python's lock, so that a program can import and read meanwhile.

    Parameters
    ----------
    paths, runtime, full_precision
        As in `open_networks`. What was begun is taken up once, and with the same values only.
    """
    _begun[(tuple(paths), runtime, full_precision)] = _loading.submit(
        _open_together, paths, runtime, full_precision
    )


def open_networks(
    paths: Sequence[Path], runtime: str = "auto", *, full_precision: bool = False
) -> list[Network]:
    """Load files whose hashes were verified, side by side where OpenVINO runs them.

    Parameters
    ----------
    paths : sequence of Path
        The files, no two of them the same.
    runtime, full_precision
        As in `open_network`, whose errors it raises.

    Examples
    --------
    >>> from cucumbervision.perception.registry import load_registry
    >>> names = ("cucumber-ends", "cucumber-crops")
    >>> files = [load_registry().resolve(name)["network"] for name in names]
    >>> [network.inputs[0].shape[2:] for network in open_networks(files)]
    [(64, 192), (96, 96)]
    """
    begun = _begun.pop((tuple(paths), runtime, full_precision), None)
    return _open_together(paths, runtime, full_precision) if begun is None else begun.result()


def _open_together(paths: Sequence[Path], runtime: str, full_precision: bool) -> list[Network]:
    if runtime in ("auto", "openvino") and importlib.util.find_spec("openvino"):
        # `open_network` takes another runtime, or says which file it is.
        with suppress(ModelError):
            return _open_openvino({str(path): path for path in paths}, full_precision)
    return [_open_alone(path, runtime, full_precision, verified=True) for path in paths]


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


def _check_graph(path: Path | bytes, source: str) -> None:
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
        raise _unreadable(source, "ONNX Runtime", error) from error


def _first_line(error: Exception) -> str:
    """Return a runtime's error message without source lines, at most 200 characters."""
    lines = [line.strip() for line in str(error).splitlines()]
    lines_kept = [line for line in lines if line and not line.startswith("Exception from ")]
    return (" ".join(lines_kept) or type(error).__name__)[:200].rstrip(".")


def _unreadable(source: str, runtime: str, error: Exception) -> ModelError:
    return ModelError(
        f"{runtime} cannot load it ({_first_line(error)})",
        source=source,
        remedy="give a complete ONNX file, exported from a checkpoint"
        + (", or choose the runtime auto" if runtime == "OpenVINO" else ""),
    )


def _open_onnxruntime(
    path: Path | bytes,
    source: str,
    runtime: str,
    full_precision: bool,
    why: str = "",
    *,
    loops: bool = False,
) -> Network:
    ort = import_onnxruntime()
    wanted_providers = _PROVIDERS[runtime]
    if wanted_providers[0] not in ort.get_available_providers():
        raise ModelError(f"ONNX Runtime has no {wanted_providers[0]} here", remedy=_GPU_REMEDY)
    options = ort.SessionOptions()
    options.log_severity_level = 4
    # Otherwise its threads spin for 30 ms after each run and slow the rest down.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    if _most_threads is not None:
        options.intra_op_num_threads = _most_threads
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
        raise _unreadable(source, "ONNX Runtime", error) from error
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


_LONGEST_RUN_S = (
    300.0  # SAM takes 10 s on a slow processor; a network with a loop may run without end
)


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


@lru_cache(maxsize=1)
def _openvino_core() -> Any:
    return import_openvino().Core()


def _open_openvino(files: Mapping[str, Path | bytes], full_precision: bool) -> list[Network]:
    """Load files, named for errors; they compile side by side, each mostly on one core."""
    settings: dict[str, Any] = {"PERFORMANCE_HINT": "LATENCY"}
    if full_precision:
        settings["INFERENCE_PRECISION_HINT"] = "f32"
    if _most_threads is not None:
        settings["INFERENCE_NUM_THREADS"] = _most_threads
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
            raise _unreadable(", ".join(files), "OpenVINO", error) from error


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
