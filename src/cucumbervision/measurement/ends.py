"""Whether the picture shows both ends of a fruit: what keypoints and mask say of it together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.measurement.m4 import MIN_VISIBILITY

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["end_flags"]

# Below M4's own 0.50: the package's pose network is less sure than that of ends in full sight.
IN_SIGHT = 0.40
BEYOND = 0.10  # of the fruit's length: some times what a pose network errs by at an end


def end_flags(
    mask: NDArray[np.bool_] | None, keypoints: NDArray[np.float64] | None
) -> tuple[str, ...]:
    """Say what keypoints tell of a fruit's ends.

    An end is hidden when its keypoint is seen badly (visibility below 0.40), or lies
    more than 10 % of the fruit's length beyond the mask: the network knows that the fruit goes on
    behind what covers it. Where the mask goes on beyond a keypoint by as much, one of the two is
    wrong.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W), optional
        The fruit's visible pixels.
    keypoints : ndarray of float, shape (5, 3), optional
        u, v in pixels and visibility, KP0 (blossom end) to KP4 (stem end). Those of which none is
        visible tell nothing.

    Returns
    -------
    tuple of str
        'end-hidden', 'ends-disagree', both or none.

    Examples
    --------
    >>> mask = np.zeros((100, 200), bool)
    >>> mask[45:55, 20:140] = True
    >>> line = np.array([[u, 50.0, 1.0] for u in (20, 55, 90, 125, 160)])
    >>> end_flags(mask, line)
    ('end-hidden',)
    >>> end_flags(mask, line * [0.85, 1, 1])
    ()
    """
    if keypoints is None or not (keypoints[:, 2] >= MIN_VISIBILITY).any():
        return ()
    hidden = bool((keypoints[[0, -1], 2] < IN_SIGHT).any())
    reaches = _reaches(mask, keypoints[:, :2])
    hidden |= any(reach < -BEYOND for reach in reaches)
    disagree = any(reach > BEYOND for reach in reaches)
    named = {"end-hidden": hidden, "ends-disagree": disagree}
    return tuple(flag for flag, holds in named.items() if holds)


def _reaches(mask: NDArray[np.bool_] | None, line: NDArray[np.float64]) -> list[float]:
    """Say how far the mask goes beyond each end's keypoint, as a share of the keypoints' line."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    if mask is None or not mask.any() or not steps.all():
        return []
    rows = np.flatnonzero(mask.any(axis=1))
    v, u = np.nonzero(mask[rows[0] : rows[-1] + 1])
    pixels = np.column_stack([u, v + rows[0]]).astype(np.float64)
    # Each pixel belongs to the part of the line that it is nearest to: a bent fruit's other end
    # does not count.
    middles = (line[:-1] + line[1:]) / 2
    nearest = ((pixels[:, None] - middles) ** 2).sum(axis=2).argmin(axis=1)
    reaches = []
    for tip, inner, part in ((0, 1, 0), (-1, -2, len(middles) - 1)):
        ahead = (line[tip] - line[inner]) / np.linalg.norm(line[tip] - line[inner])
        own = pixels[nearest == part]
        # No pixel at all near this part: the mask ends before it.
        reach = float(((own - line[tip]) @ ahead).max()) if len(own) else -float(steps[part])
        reaches.append(reach / float(steps.sum()))
    return reaches
