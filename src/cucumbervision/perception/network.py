"""A loaded network, whichever runtime runs it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.perception.card import Card, CardArray, Feed, Levels

Array: TypeAlias = np.ndarray[Any, np.dtype[Any]]


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


def _first_line(error: Exception) -> str:
    """Return a runtime's error message without source lines, at most 200 characters."""
    lines = [line.strip() for line in str(error).splitlines()]
    lines_kept = [line for line in lines if line and not line.startswith("Exception from ")]
    return (" ".join(lines_kept) or type(error).__name__)[:200].rstrip(".")


def unreadable(source: str, runtime: str, error: Exception) -> ModelError:
    """Return the error of a file that a runtime cannot load."""
    return ModelError(
        f"{runtime} cannot load it ({_first_line(error)})",
        source=source,
        remedy="give a complete ONNX file, exported from a checkpoint"
        + (", or choose the runtime auto" if runtime == "OpenVINO" else ""),
    )
