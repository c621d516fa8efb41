"""Evaluate each end of a fruit by a network: whether it is the true end, and the missing length.

Depth shows an object beside an end, but not whether the fruit continues behind it: leaves and
stems hang at nearly the same distance as the fruit. A network of a few layers evaluates the picture
around each end of a measured axis, rotated so that the fruit always comes from the left.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.instances.end_crops import END_PX, EndCrop, EndLook
from cucumbervision.instances.turned_crops import PLANES
from cucumbervision.perception.small_network import SmallNetwork

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


STATES = ("true", "covered", "running on")
"""What an end may be, in the order of the network's output."""

ERROR_SCALE = 0.02
"""Of the length: the network's quantiles are asinh(share / ERROR_SCALE), fine near zero."""


class EndLooker(SmallNetwork):
    """Evaluates the ends of fruit.

    Parameters and errors are those of `SmallNetwork`.
    """

    shapes = ((PLANES, END_PX, END_PX), (2,))
    takes = "crops of ends"
    command = "train classifier look"

    def look(self, crops: Sequence[EndCrop]) -> list[EndLook]:
        """Return the evaluation of ends, computed in one batch.

        Parameters
        ----------
        crops : sequence of EndCrop
            Results of `end_crop`. The outputs of each crop and its mirror image are averaged.
        """
        if not crops:
            return []
        planes = np.stack([crop.planes for crop in crops])
        shapes = np.tile(np.array([crop.shape for crop in crops], np.float32), (2, 1))
        (rows,) = self._run(np.concatenate([planes, planes[:, ::-1]]), shapes).values()
        mean = np.asarray(rows, np.float64).reshape(2, len(crops), -1).mean(axis=0)
        return [looked_at(row) for row in mean]


def looked_at(row: NDArray[np.float64]) -> EndLook:
    """Convert the network's output for one end.

    Parameters
    ----------
    row : ndarray of float64, shape (9,)
        Logits of the `STATES`, quantiles as asinh(share / `ERROR_SCALE`), and the logit of the
        stem end.

    Examples
    --------
    >>> look = looked_at(np.array([0.0, 0, 0, -1, 0, 0, 1, 5, 0]))
    >>> round(look.covered, 2), [round(share, 3) for share in look.missing], look.stem
    (0.33, [-0.024, 0.0, 0.0, 0.024, 1.484], 0.5)
    """
    states = np.exp(row[:3] - row[:3].max())
    true, covered, running_on = (states / states.sum()).tolist()
    shares = np.sort(ERROR_SCALE * np.sinh(row[3:8]))
    return EndLook(
        true=true,
        covered=covered,
        running_on=running_on,
        missing=tuple(shares.tolist()),
        stem=float(1 / (1 + np.exp(-row[8]))),
    )
