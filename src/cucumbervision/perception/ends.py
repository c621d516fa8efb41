"""The stem end of a fruit, found by a small network on a straightened crop.

The pose networks trained here give five points from a fruit's lower left to its upper right end.
The fruit is resampled along them into a horizontal strip, and a network of a few layers classifies
which side has the stem. A rotation of the strip by 180 degrees exactly negates its output.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.curve import arc_positions, points_along
from cucumbervision.geometry.pixels import sample_color
from cucumbervision.perception.small_network import PictureClassifier

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


STRIP_PX = (64, 192)
"""Height and width of a strip."""


_BEYOND = 0.25  # of the fruit's length, shown beyond each end for the stalk
_HALF_WIDTH = 0.25  # of the fruit's length, shown on either side


def orient(
    color_rgb: NDArray[np.uint8], points_px: NDArray[np.float64]
) -> NDArray[np.uint8] | None:
    """Resample a fruit along its keypoints into a horizontal strip.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    points_px : ndarray of float64, shape (K, 2)
        u, v along the fruit's axis, from end to end.

    Returns
    -------
    ndarray of uint8, shape (64, 192, 3), or None
        The first point is on the left, with 0.25 of the length beyond either end; None if the
        points span less than 4 pixels.

    Examples
    --------
    >>> picture = np.zeros((60, 120, 3), np.uint8)
    >>> picture[20:40, 70:100] = (255, 0, 0)  # a red stem end, to the right
    >>> line = np.column_stack([np.linspace(20, 100, 5), np.full(5, 30.0)])
    >>> level, turned = orient(picture, line), orient(picture, line[::-1])
    >>> bool((level[32, 120:155, 0] > 200).all()), bool((turned[32, 37:72, 0] > 200).all())
    (True, True)
    """
    run = arc_positions(points_px)
    length = float(run[-1])
    points = points_px[np.concatenate([[True], np.diff(run) > 0])]
    if len(points) < 2 or length < 4 or not np.isfinite(points).all():
        return None
    height, width = STRIP_PX
    first, last = (
        out / np.linalg.norm(out) for out in (points[0] - points[1], points[-1] - points[-2])
    )
    further = 2 * _BEYOND * length
    line = np.vstack([points[0] + further * first, points, points[-1] + further * last])
    shares = (np.linspace(-_BEYOND, 1 + _BEYOND, width) + 2 * _BEYOND) / (1 + 4 * _BEYOND)
    middle = points_along(line, shares)
    ahead = np.gradient(middle, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    aside = np.linspace(-_HALF_WIDTH, _HALF_WIDTH, height)[:, None, None] * length
    sample_px = middle[None] + aside * np.column_stack([-ahead[:, 1], ahead[:, 0]])[None]
    return sample_color(color_rgb, sample_px, length * (1 + 2 * _BEYOND) / width)


class EndClassifier(PictureClassifier):
    """Classifies which end of a fruit is the stem's.

    Parameters and errors are those of `SmallNetwork`.
    """

    shapes = ((3, *STRIP_PX),)
    takes = "fruit laid level"
    command = "train classifier ends"

    def log_odds(
        self, color_rgb: NDArray[np.uint8], lines_px: Sequence[NDArray[np.float64]]
    ) -> list[float | None]:
        """Return the log-odds that lines run from blossom end to stem end.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The picture.
        lines_px : sequence of ndarray of float64, shape (K, 2)
            u, v along each fruit's axis, from end to end.

        Returns
        -------
        list of float or None
            The mean of the strip's and its mirror image's; None for a line too short to tell.
        """
        strips = [orient(color_rgb, line) for line in lines_px]
        strips_read = [strip for strip in strips if strip is not None]
        if not strips_read:
            return [None] * len(strips)
        level = np.stack(strips_read)
        scores = iter(self.mean_logits(level, level[:, ::-1]).tolist())
        return [None if strip is None else next(scores) for strip in strips]
