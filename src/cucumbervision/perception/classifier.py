"""A small network with one logit per picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ModelError
from cucumbervision.perception.runtime import open_network

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


class PictureClassifier:
    """Classifies pictures of one size.

    Parameters
    ----------
    path : Path
        The ONNX file.
    runtime : str
        As for `open_network`; 'auto' is ONNX Runtime, the fastest for a network this small.
    size_px : tuple of int
        Height and width of a picture.
    takes : str
        Description of the pictures, for the error.
    command : str
        The command that trains such a network, for the error.

    Raises
    ------
    ModelError
        If the file cannot be loaded or is another kind of network.
    """

    def __init__(
        self, path: Path, runtime: str, *, size_px: tuple[int, int], takes: str, command: str
    ) -> None:
        chosen = "onnxruntime" if runtime == "auto" else runtime
        self._network = open_network(path, chosen, full_precision=True)
        shape = self._network.inputs[0].shape
        if shape[1:] != (3, *size_px) or len(self._network.outputs) != 1:
            raise ModelError(
                f"takes {shape}, not {takes}",
                source=path,
                remedy=f"name a network by `cucumbervision {command}`",
            )

    @property
    def runtime(self) -> str:
        """The runtime, as `Network.runtime`."""
        return self._network.runtime

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
        planes = batch.transpose(0, 3, 1, 2).astype(np.float32) / np.float32(255)
        (answer,) = self._network.run({self._network.inputs[0].name: planes}).values()
        return np.asarray(answer.reshape(2, -1).mean(axis=0), np.float64)
