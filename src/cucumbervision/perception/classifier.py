"""A small network with one logit per picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.perception.runtime import open_network

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray


class SmallNetwork:
    """A network so small that ONNX Runtime runs it fastest.

    Parameters
    ----------
    path : Path
        The ONNX file.
    runtime : str
        As for `open_network`; 'auto' is ONNX Runtime.
    shapes : sequence of tuple of int
        Shape of each input, without the number of pictures.
    takes : str
        What the inputs are, for the error.
    command : str
        The command that trains such a network, for the error.
    outputs : int
        Number of outputs.

    Raises
    ------
    ModelError
        If the file cannot be loaded or is another kind of network.
    """

    def __init__(
        self,
        path: Path,
        runtime: str,
        *,
        shapes: Sequence[tuple[int, ...]],
        takes: str,
        command: str,
        outputs: int = 1,
    ) -> None:
        chosen = "onnxruntime" if runtime == "auto" else runtime
        self._network = open_network(path, chosen, full_precision=True)
        inputs = [tuple(tensor.shape[1:]) for tensor in self._network.inputs]
        if inputs != list(shapes) or len(self._network.outputs) != outputs:
            raise ModelError(
                f"takes {inputs}, not {takes}",
                source=path,
                remedy=f"name a network by `cucumbervision {command}`",
            )

    @property
    def runtime(self) -> str:
        """What runs it, as `Network.runtime`."""
        return self._network.runtime


class PictureClassifier(SmallNetwork):
    """Classifies pictures of one size.

    Parameters
    ----------
    path, runtime, takes, command
        As for `SmallNetwork`.
    size_px : tuple of int
        Height and width of a picture.
    """

    def __init__(
        self, path: Path, runtime: str, *, size_px: tuple[int, int], takes: str, command: str
    ) -> None:
        super().__init__(path, runtime, shapes=[(3, *size_px)], takes=takes, command=command)

    def mean_logits(
        self, pictures: NDArray[np.uint8], mirrored: NDArray[np.uint8]
    ) -> NDArray[np.float64]:
        """Return the mean logit of each picture and its mirror image.

        Parameters
        ----------
        pictures, mirrored : ndarray of uint8, shape (N, H, W, 3)
            RGB; at least one picture.

        Returns
        -------
        ndarray of float64, shape (N,)
        """
        batch = np.concatenate([pictures, mirrored])
        planes = np.empty((len(batch), 3, *batch.shape[1:3]), np.float32)
        np.divide(batch.transpose(0, 3, 1, 2), np.float32(255), out=planes, dtype=np.float32)
        (answer,) = self._network.run({self._network.inputs[0].name: planes}).values()
        return np.asarray(answer.reshape(2, -1).mean(axis=0), np.float64)
