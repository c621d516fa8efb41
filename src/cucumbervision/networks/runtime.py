"""Load networks and run them: with a provider of ONNX Runtime, or with OpenVINO.

A network is code: load only files that you trust. Files are loaded as a whole, so that weights in
another file, which no hash would cover, are refused by the runtimes.

Both libraries send data by default: ONNX Runtime 1.29 and later keeps a device id and a store of
events under the user's cache folder, and `import openvino` sends an event. `import_onnxruntime` and
`_import_openvino` disable that; no other module imports the libraries.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cucumbervision.arrays import Array32, Numbers, Pixels
from cucumbervision.errors import MissingExtraError, ModelError, OutOfMemoryError, named_error

CARD_RUNTIMES = ("cuda", "tensorrt")
RUNTIMES = ("auto", "onnxruntime", "openvino", *CARD_RUNTIMES)

_CPU = "CPUExecutionProvider"
_CUDA_EXACT = {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"}  # chosen without timing
# Providers of ONNX Runtime in the order of choice, with options in full precision and otherwise.
_PROVIDERS: Mapping[str, tuple[tuple[str, Mapping[str, str], Mapping[str, str]], ...]] = {
    "onnxruntime": ((_CPU, {}, {}),),
    "cuda": (("CUDAExecutionProvider", _CUDA_EXACT, {"use_tf32": "1"}), (_CPU, {}, {})),
    "tensorrt": (
        ("TensorrtExecutionProvider", {"trt_fp16_enable": "0"}, {"trt_fp16_enable": "1"}),
        ("CUDAExecutionProvider", _CUDA_EXACT, {"use_tf32": "1"}),
        (_CPU, {}, {}),
    ),
}
_PRECISIONS = {  # by whether it is to be full
    "onnxruntime": ("cpu", "cpu"),
    "cuda": ("cuda, tf32", "cuda, f32"),
    "tensorrt": ("tensorrt, f16", "tensorrt, f32"),
}
_GPU_REMEDY = "install onnxruntime-gpu in place of onnxruntime, or choose the runtime auto"
_ONNX_FLOATS = {"float": "float32", "double": "float64"}  # other types have the names of NumPy

_log = logging.getLogger("cucumbervision")
_starting_openvino = threading.RLock()  # two threads may each open a network
_most_threads: int | None = None


def limit_threads(threads: int | None) -> None:
    """Limit the threads of all networks loaded later in this process."""
    global _most_threads
    _most_threads = threads


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
    """

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    metadata: Mapping[str, str]
    runtime: str
    source: str
    compute: Callable[[dict[str, Numbers]], list[Numbers]]

    def run(self, feeds: Mapping[str, Numbers]) -> dict[str, Numbers]:
        """Run the network once.

        Parameters
        ----------
        feeds : mapping of str to ndarray
            Every input by name; values are converted to the input's dtype.

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
        arrays = {i.name: np.ascontiguousarray(feeds[i.name], i.dtype) for i in self.inputs}
        try:
            outputs = self.compute(arrays)
        # The two runtimes raise their own classes and plain RuntimeError alike.
        except Exception as error:
            if isinstance(fault := named_error(error, self.source), OutOfMemoryError):
                raise fault from error
            sizes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
            raise ModelError(
                f"the network fails on {sizes}: {_first_line(error)}",
                source=self.source,
                remedy="give pictures of the size that it was exported for",
            ) from error
        named = zip(self.outputs, outputs, strict=True)
        return {info.name: self._checked(info.name, array) for info, array in named}

    def _checked(self, name: str, array: Numbers) -> Numbers:
        # The extremes show what is not finite, and need no memory beside that of a large output.
        extremes = (array.min(), array.max()) if array.dtype.kind == "f" and array.size else ()
        if not np.isfinite(extremes).all():
            raise ModelError(
                f"the network's output {name!r} has numbers that are not finite",
                source=self.source,
                remedy="export it again; half precision may overflow",
            )
        return array.astype(np.float32) if array.dtype == np.float16 else array


def open_network(
    path: Path | str | bytes, runtime: str = "auto", *, full_precision: bool = False, name: str = ""
) -> Network:
    """Load an ONNX file, which must be one that you trust.

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

    Returns
    -------
    Network

    Raises
    ------
    ModelError
        If the file is missing or not a network, the runtime unknown, or its provider not available.
    MissingExtraError
        If 'openvino' is asked for and not installed.

    Examples
    --------
    >>> from cucumbervision.networks.registry import load_registry
    >>> path = load_registry().resolve("cucumber-seg")["network"]
    >>> [info.name for info in open_network(path).inputs]
    ['images']
    """
    if runtime not in RUNTIMES:
        raise ModelError(
            f"no runtime is called {runtime!r}", remedy=f"choose one of {', '.join(RUNTIMES)}"
        )
    source = (name or "network in memory") if isinstance(path, bytes) else str(path)
    if not isinstance(path, bytes):
        if not Path(path).is_file():
            raise ModelError("there is no such file", source=source, remedy="check the path")
        path = Path(path).read_bytes()
    why = ""
    if runtime == "openvino" or (runtime == "auto" and importlib.util.find_spec("openvino")):
        try:
            return _by_openvino(path, source, full_precision=full_precision)
        except ModelError as error:
            if runtime == "openvino":
                raise
            _log.info("%s: %s, so ONNX Runtime runs it", source, error.message)
            why = "; OpenVINO cannot load it"
    chosen = "onnxruntime" if runtime == "auto" else runtime
    return _by_onnxruntime(path, source, chosen, full_precision=full_precision, why=why)


def input_planes(
    pixels: Pixels,
    mean: Sequence[float] = (0.0,),
    scale: Sequence[float] = (255.0,),
    size_px: tuple[int, int] | None = None,
) -> Array32:
    """Return images as an input that takes (level - mean) / scale by planes.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (N, H, W, C)
        The images.
    mean, scale : sequence of float
        One of each per channel, or one for all.
    size_px : tuple of int, optional
        Height and width of the input; zeros fill it to the right and below.

    Returns
    -------
    ndarray of float32, shape (N, C, height, width)

    Examples
    --------
    >>> input_planes(np.full((1, 2, 2, 3), 51, np.uint8))[0, :, 0, 0].tolist()
    [0.20000000298023224, 0.20000000298023224, 0.20000000298023224]
    """
    count, rows, columns, channels = pixels.shape
    planes = np.zeros((count, channels, *(size_px or (rows, columns))), np.float32)
    means, scales = (
        np.broadcast_to(np.asarray(values, np.float32), (channels,)) for values in (mean, scale)
    )
    for picture, out in zip(pixels, planes, strict=True):
        for channel, levels in enumerate(cv2.split(picture)):
            inside = out[channel, :rows, :columns]
            # Divided, not multiplied by 1/255: the same float32 values as Ultralytics'.
            np.subtract(levels, means[channel], out=inside, dtype=np.float32)
            inside /= scales[channel]
    return planes


def runtime_for_batches(runtime: str) -> str:
    """Return the runtime of a network whose batches differ in size from image to image.

    TensorRT would compile for minutes at each new size, so CUDA runs it. On a processor ONNX
    Runtime is the fastest for small networks.

    Examples
    --------
    >>> [runtime_for_batches(asked) for asked in ("tensorrt", "auto", "openvino")]
    ['cuda', 'onnxruntime', 'openvino']
    """
    return {"auto": "onnxruntime", "tensorrt": "cuda"}.get(runtime, runtime)


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


def _by_onnxruntime(
    network: bytes, source: str, runtime: str, *, full_precision: bool, why: str
) -> Network:
    ort = import_onnxruntime()
    wanted, available = _PROVIDERS[runtime], ort.get_available_providers()
    if wanted[0][0] not in available:
        raise ModelError(f"ONNX Runtime has no {wanted[0][0]} here", remedy=_GPU_REMEDY)
    options = ort.SessionOptions()
    options.log_severity_level = 4
    # Otherwise its threads spin for 30 ms after each run and slow the rest down.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    if _most_threads is not None:
        options.intra_op_num_threads = _most_threads
    providers = [
        (name, dict(exact if full_precision else fast))
        for name, exact, fast in wanted
        if name in available
    ]
    try:
        session = ort.InferenceSession(network, options, providers=providers)
        inputs = tuple(_onnx_info(i) for i in session.get_inputs())
        outputs = tuple(_onnx_info(o) for o in session.get_outputs())
        metadata = dict(session.get_modelmeta().custom_metadata_map)
    except Exception as error:  # its classes derive from Exception alone
        raise _unreadable(source, "ONNX Runtime", error) from error
    if wanted[0][0] not in session.get_providers():
        raise ModelError(f"{wanted[0][0]} does not start", source=source, remedy=_GPU_REMEDY)
    return Network(
        inputs=inputs,
        outputs=outputs,
        metadata=metadata,
        runtime=f"onnxruntime ({_PRECISIONS[runtime][full_precision]}{why})",
        source=source,
        compute=partial(session.run, [o.name for o in outputs]),
    )


def _onnx_info(arg: Any) -> TensorInfo:
    shape = tuple(n if isinstance(n, int) else None for n in arg.shape)
    kind = arg.type.removeprefix("tensor(").removesuffix(")")
    kind = _ONNX_FLOATS.get(kind, kind)
    return TensorInfo(arg.name, shape, np.dtype(kind if kind in np.sctypeDict else "object"))


@lru_cache(maxsize=1)
def _import_openvino() -> Any:
    """Return OpenVINO's core, imported with the telemetry off.

    OpenVINO falls back on a stub of its own where the package openvino_telemetry cannot be
    imported, so it is hidden while OpenVINO loads.
    """
    modules: dict[str, Any] = sys.modules
    before = modules.get("openvino_telemetry")
    modules["openvino_telemetry"] = None
    try:
        import openvino
    except ModuleNotFoundError as error:
        raise MissingExtraError("openvino", "openvino") from error
    finally:
        del modules["openvino_telemetry"]
        if before is not None:
            modules["openvino_telemetry"] = before
    return openvino.Core()


def _by_openvino(network: bytes, source: str, *, full_precision: bool) -> Network:
    settings: dict[str, Any] = {"PERFORMANCE_HINT": "LATENCY"}
    if full_precision:
        settings["INFERENCE_PRECISION_HINT"] = "f32"
    if _most_threads is not None:
        settings["INFERENCE_NUM_THREADS"] = _most_threads
    with _starting_openvino:
        core = _import_openvino()
        try:
            model = core.read_model(network)
            compiled = core.compile_model(model, "CPU", settings)
            inputs, outputs = (
                tuple(_openvino_info(port) for port in ports)
                for ports in (compiled.inputs, compiled.outputs)
            )
        except Exception as error:
            raise _unreadable(source, "OpenVINO", error) from error
    # It keeps an ONNX file's custom metadata as the model's 'framework'.
    has_metadata = model.has_rt_info("framework")
    metadata = model.get_rt_info("framework").value.items() if has_metadata else ()
    request, one_at_a_time = compiled.create_infer_request(), threading.Lock()

    def compute(feeds: dict[str, Numbers]) -> list[Numbers]:
        with one_at_a_time:
            request.infer(feeds, share_inputs=True)
            # Copy, since the next run overwrites the request's buffers.
            return [request.get_output_tensor(i).data.copy() for i in range(len(outputs))]

    return Network(
        inputs=inputs,
        outputs=outputs,
        metadata={key: str(value) for key, value in metadata},
        runtime=f"openvino ({compiled.get_property('INFERENCE_PRECISION_HINT').to_string()})",
        source=source,
        compute=compute,
    )


def _openvino_info(port: Any) -> TensorInfo:
    shape = tuple(d.get_length() if d.is_static else None for d in port.get_partial_shape())
    return TensorInfo(port.get_any_name(), shape, np.dtype(port.get_element_type().to_dtype()))


def _first_line(error: Exception) -> str:
    """Return a runtime's error message without source lines, at most 200 characters."""
    lines = [line.strip() for line in str(error).splitlines()]
    kept_lines = [line for line in lines if line and not line.startswith("Exception from ")]
    return (" ".join(kept_lines) or type(error).__name__)[:200].rstrip(".")


def _unreadable(source: str, runtime: str, error: Exception) -> ModelError:
    remedy = "give a complete ONNX file, exported from a checkpoint"
    if runtime == "OpenVINO":
        remedy += ", or choose the runtime auto"
    return ModelError(
        f"{runtime} cannot load it ({_first_line(error)})", source=source, remedy=remedy
    )
