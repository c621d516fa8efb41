"""Small networks that look at the pictures of single fruit or ends."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.perception.resize import input_planes
from cucumbervision.perception.runtime import open_network, runtime_for_batches

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


class SmallNetwork:
    """A network so small that ONNX Runtime runs it fastest.

    Parameters
    ----------
    path : Path
        An ONNX file as the class's `command` writes it.
    runtime : str
        As for `open_network`, and as `runtime_for_batches` changes it.

    Raises
    ------
    ModelError
        If the file cannot be loaded or is another kind of network.
    """

    shapes: ClassVar[tuple[tuple[int, ...], ...]]
    """Shape of each input, without the number of pictures; the first input is the pictures."""

    takes: ClassVar[str]
    """What the pictures show, for the error."""

    command: ClassVar[str]
    """The command that trains such a network, for the error."""

    outputs: ClassVar[int] = 1
    """Number of outputs."""

    def __init__(self, path: Path, runtime: str = "auto") -> None:
        chosen = runtime_for_batches(runtime)
        self._network = open_network(path, chosen, full_precision=True)
        inputs = tuple(tuple(tensor.shape[1:]) for tensor in self._network.inputs)
        if inputs != self.shapes or len(self._network.outputs) != self.outputs:
            raise ModelError(
                f"takes {list(inputs)}, not {self.takes}",
                source=path,
                remedy=f"name a network by `cucumbervision {self.command}`",
            )

    @property
    def runtime(self) -> str:
        """What runs it, as `Network.runtime`."""
        return self._network.runtime

    def _run(
        self, pictures: NDArray[np.uint8], *values: NDArray[np.float32]
    ) -> dict[str, NDArray[np.float32]]:
        """Return the outputs by name for pictures (N, H, W, C) and the values of other inputs."""
        names = [tensor.name for tensor in self._network.inputs]
        return self._network.run(dict(zip(names, (input_planes(pictures), *values), strict=True)))
