"""Networks on a graphics card: what stays there, what is computed there, and how sessions are set.

Copies cost more than small networks: pictures go to the card as bytes and become numbers there, an
output that only another network needs stays there, and of a detector's prototypes only their
weighted sums come back.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cucumbervision.errors import ModelError, wrap_os_errors
from cucumbervision.perception.onnx_file import Node, small_network

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from numpy.typing import NDArray

Array: TypeAlias = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True, eq=False)
class Levels:
    """Pictures in whole levels, for an input that takes (level - mean) / scale by planes.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (N, H, W, C)
        The pictures.
    mean, scale : sequence of float
        One of each per channel, or one for all.
    size_px : tuple of int, optional
        Height and width of the input; zeros fill it to the right and below.

    Examples
    --------
    >>> Levels(np.full((1, 2, 2, 3), 51, np.uint8)).planes()[0, :, 0, 0].tolist()
    [0.20000000298023224, 0.20000000298023224, 0.20000000298023224]
    """

    pixels: NDArray[np.uint8]
    mean: Sequence[float] = (0.0,)
    scale: Sequence[float] = (255.0,)
    size_px: tuple[int, int] | None = None

    def per_channel(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return mean and scale of each channel."""
        channels = self.pixels.shape[3]
        mean, scale = (
            np.broadcast_to(np.asarray(values, np.float32), (channels,)).copy()
            for values in (self.mean, self.scale)
        )
        return mean, scale

    def planes(self) -> NDArray[np.float32]:
        """Return the input, float32, shape (N, C, height, width)."""
        import cv2

        count, rows, columns, channels = self.pixels.shape
        size = self.size_px or (rows, columns)
        planes = np.empty((count, channels, *size), np.float32)
        if size != (rows, columns):
            planes[:] = 0
        mean, scale = self.per_channel()
        for picture, out in zip(self.pixels, planes, strict=True):
            for channel, levels in enumerate(cv2.split(picture)):
                inside = out[channel, :rows, :columns]
                # Divided, not multiplied by 1/255: the same float32 values as Ultralytics'.
                if mean[channel]:
                    np.subtract(levels, mean[channel], out=inside, dtype=np.float32)
                    inside /= scale[channel]
                else:
                    np.divide(levels, scale[channel], out=inside, dtype=np.float32)
        return planes


@dataclass(frozen=True, eq=False)
class CardArray:
    """An output that stayed on the card, to be given to a network of the same runtime."""

    value: Any

    def numpy(self) -> Array:
        """Return a copy in the processor's memory."""
        return np.asarray(self.value.numpy())


Feed: TypeAlias = Array | Levels | CardArray


@dataclass(eq=False)
class Card:
    """A session on a card, whose inputs and outputs are bound.

    Parameters
    ----------
    session : onnxruntime.InferenceSession
        The session.
    outputs : sequence of str
        Names of all its outputs.
    open_piece : callable
        Opens the content of a small network on the same card, in float32.
    ort : module
        ONNX Runtime.
    device : str
        Name of the card's memory: 'cuda'.
    """

    session: Any
    outputs: Sequence[str]
    open_piece: Callable[[bytes], Any]
    ort: Any
    device: str = "cuda"
    _places: dict[str, Any] = field(default_factory=dict)
    _pieces: dict[bytes, Any] = field(default_factory=dict)
    _one_at_a_time: Any = field(default_factory=threading.Lock)

    def run(self, feeds: Mapping[str, Feed], kept: Collection[str] = ()) -> list[Any]:
        """Run the session once.

        Parameters
        ----------
        feeds : mapping of str to ndarray, Levels or CardArray
            Every input.
        kept : collection of str
            Names of outputs that stay on the card.

        Returns
        -------
        list of ndarray or CardArray
            Every output, in order.
        """
        with self._one_at_a_time:  # the memory of its inputs is used again
            placed = {name: self._placed(name, feed) for name, feed in feeds.items()}
            return self._bound(self.session, placed, self.outputs, kept)

    def mixed(self, prototypes: CardArray, weights: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return sums of prototypes, computed on the card.

        Parameters
        ----------
        prototypes : CardArray
            Shape (1, C, h, w).
        weights : ndarray of float32, shape (N, C)
            Of each detection.

        Returns
        -------
        ndarray of float32, shape (N, h, w)
        """
        if not len(weights):
            return np.zeros((0, *prototypes.value.shape()[2:]), np.float32)
        with self._one_at_a_time:
            placed = {"weights": self._upload("weights", weights), "prototypes": prototypes.value}
            (sums,) = self._bound(self._piece(_MIXTURE), placed, ["sums"])
        return np.asarray(sums, np.float32)

    def _placed(self, name: str, feed: Feed) -> Any:
        if isinstance(feed, CardArray):
            return feed.value
        if not isinstance(feed, Levels):
            return self._upload(name, feed)
        rows, columns = feed.pixels.shape[1:3]
        height, width = feed.size_px or (rows, columns)
        mean, scale = feed.per_channel()
        padding = np.array([0, 0, 0, 0, 0, 0, height - rows, width - columns], np.int64)
        placed = {
            "pixels": self._upload(name, feed.pixels),
            **{"mean": self._upload("mean", mean), "scale": self._upload("scale", scale)},
        }
        (planes,) = self._bound(
            self._piece(_PLANES), placed, ["planes"], ["planes"], padding=padding
        )
        return planes.value

    def _upload(self, name: str, array: Array) -> Any:
        """Copy an array into the card's memory, where the last one of its kind lay."""
        array = np.ascontiguousarray(array)
        place = self._places.get(name)
        if place is None or (place.shape(), place.numpy_dtype) != (list(array.shape), array.dtype):
            place = _Place(
                self.ort.OrtValue.ortvalue_from_shape_and_type(
                    list(array.shape), array.dtype.type, self.device, 0
                ),
                array.dtype,
            )
            self._places[name] = place
        place.value.update_inplace(array)
        return place.value

    def _piece(self, content: bytes) -> Any:
        if content not in self._pieces:
            self._pieces[content] = self.open_piece(content)
        return self._pieces[content]

    def _bound(
        self,
        session: Any,
        placed: Mapping[str, Any],
        outputs: Sequence[str],
        kept: Collection[str] = (),
        **small: Array,
    ) -> list[Any]:
        binding = session.io_binding()
        for name, value in placed.items():
            binding.bind_ortvalue_input(name, value)
        for name, array in small.items():
            binding.bind_cpu_input(name, array)
        for name in outputs:
            binding.bind_output(name, self.device if name in kept else "cpu")
        session.run_with_iobinding(binding)
        return [
            CardArray(value) if name in kept else value.numpy()
            for name, value in zip(outputs, binding.get_outputs(), strict=True)
        ]


@dataclass(frozen=True, eq=False)
class _Place:
    """Memory of the card, and what it holds."""

    value: Any
    numpy_dtype: np.dtype[Any]

    def shape(self) -> list[int]:
        return list(self.value.shape())


_PLANES = small_network(
    [
        Node("Cast", ("pixels",), "levels", {"to": 1}),
        Node("Sub", ("levels", "mean"), "less"),
        Node("Div", ("less", "scale"), "scaled"),
        Node("Transpose", ("scaled",), "turned", {"perm": (0, 3, 1, 2)}),
        Node("Pad", ("turned", "padding"), "planes"),
    ],
    {"pixels": ("uint8", 4), "mean": ("float32", 1), "scale": ("float32", 1)}
    | {"padding": ("int64", 1)},
    {"planes": ("float32", 4)},
)
"""What `Levels.planes` computes."""

_MIXTURE = small_network(
    [Node("Einsum", ("weights", "prototypes"), "sums", {"equation": "nc,bchw->nhw"})],
    {"weights": ("float32", 2), "prototypes": ("float32", 4)},
    {"sums": ("float32", 3)},
)


def provider_options(
    provider: str, *, full_precision: bool, engines: Path | None = None
) -> dict[str, str]:
    """Return the settings of one of ONNX Runtime's providers.

    Parameters
    ----------
    provider : str
        Its name, such as 'CUDAExecutionProvider'.
    full_precision : bool
        Float32 without TF32, and algorithms of convolutions that are chosen by a rule and not by
        timing; otherwise TF32 on CUDA and half precision in TensorRT.
    engines : Path, optional
        Folder in which TensorRT keeps what it compiles, which takes minutes.

    Examples
    --------
    >>> provider_options("CUDAExecutionProvider", full_precision=True)
    {'use_tf32': '0', 'cudnn_conv_algo_search': 'HEURISTIC'}
    >>> provider_options("CPUExecutionProvider", full_precision=True)
    {}
    """
    if provider == "CUDAExecutionProvider":
        exact = {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"}
        return exact if full_precision else {"use_tf32": "1"}
    if provider != "TensorrtExecutionProvider":
        return {}
    options = {"trt_fp16_enable": "0" if full_precision else "1"}
    if engines is not None:
        for kind in ("engine", "timing"):
            options[f"trt_{kind}_cache_enable"] = "1"
            options[f"trt_{kind}_cache_path"] = str(engines)
    return options


def engine_folder(
    network: Path | bytes, *, full_precision: bool, cache: Path | None = None
) -> Path:
    """Return a folder for TensorRT's engines of one network, made if it is missing.

    TensorRT names its engines by the network's nodes and not by its weights, so every content has a
    folder of its own. An engine is code: nobody else may write there.

    Parameters
    ----------
    network : Path or bytes
        The file, or its content.
    full_precision : bool
        As for `provider_options`.
    cache : Path, optional
        Folder of all engines; by default in the user's cache.

    Raises
    ------
    ModelError
        If the folder belongs to somebody else, others may write into it, or it cannot be made.
    """
    import platformdirs

    content = network if isinstance(network, bytes) else network.read_bytes()
    stem = "network" if isinstance(network, bytes) else network.stem
    clean = re.sub(r"[^A-Za-z0-9_-]+", "_", stem)[:40]
    cache = (
        cache or Path(platformdirs.user_cache_dir("cucumbervision", appauthor=False)) / "engines"
    )
    precision = "f32" if full_precision else "f16"
    folder = cache / f"{clean}-{hashlib.sha256(content).hexdigest()[:16]}-{precision}"
    remedy = "choose the runtime cuda, or another folder by XDG_CACHE_HOME"
    with wrap_os_errors("cannot be made", cache, remedy, ModelError):
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        for owned in (cache, folder):
            _require_own(owned, owned.lstat())
    return folder


def _require_own(folder: Path, status: os.stat_result) -> None:
    others = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    strange = hasattr(os, "getuid") and (status.st_uid != os.getuid() or others)
    if stat.S_ISLNK(status.st_mode) or strange:
        raise ModelError(
            "others could put engines there, and engines are code",
            source=folder,
            remedy="remove the folder, so that it is made again",
        )
