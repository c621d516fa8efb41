"""The noise floor: who knows the tube and errs only by where the mask ends it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision_lab.synthesis.scene import FruitTruth

__all__ = ["end_shift_px", "oracle_length_m"]

BACK_SHARE = 0.12  # of the axis: where the walk to the end begins
STEP_PX, BEYOND_PX = 0.25, 25.0
SHORTEST_COS = 0.3  # an end that points along the view tells nothing of its own length


def oracle_length_m(
    truth: FruitTruth, mask: NDArray[np.bool_], camera: Intrinsics, rng: np.random.Generator
) -> float:
    """Return the true centreline, wrong only by the mask's outline at both ends.

    Each end is wrong by as many pixels as the mask's outline lies beyond (or short of) the exact
    one along the axis, plus the pixel grid's own rounding, drawn evenly from half a pixel either
    way; pixels become metres at the end's depth and slant. A hidden end is known.

    Parameters
    ----------
    truth : FruitTruth
        The fruit.
    mask : ndarray of bool, shape (H, W)
        The mask that the methods were given.
    camera : Intrinsics
        The camera.
    rng : numpy.random.Generator
        For the grid's rounding.
    """
    length = truth.centreline_m
    for axis in (truth.axis_m, truth.axis_m[::-1]):
        back = axis[max(1, round(BACK_SHARE * len(axis)))]
        tip = axis[0]
        run = tip - back
        cosine = max(float(np.hypot(run[0], run[1]) / np.linalg.norm(run)), SHORTEST_COS)
        back_px, tip_px = camera.project([back, tip])
        shift = end_shift_px(truth.visible, mask, back_px, tip_px)
        if shift is None:
            continue
        pixels = shift + float(rng.uniform(-0.5, 0.5))
        length += pixels * float(tip[2]) / camera.fx_px / cosine
    return length


def end_shift_px(
    exact: NDArray[np.bool_],
    mask: NDArray[np.bool_],
    back_px: NDArray[np.float64],
    tip_px: NDArray[np.float64],
) -> float | None:
    """Return how far a mask reaches beyond the exact one, walking from inside over the tip.

    Parameters
    ----------
    exact, mask : ndarray of bool, shape (H, W)
        The visible fruit, and its mask.
    back_px, tip_px : ndarray of float, shape (2,)
        A point of the axis inside, and the end; u, v.

    Returns
    -------
    float or None
        Pixels; None where either does not show the end.

    Examples
    --------
    >>> exact = np.zeros((20, 60), bool)
    >>> exact[8:13, 10:40] = True
    >>> mask = exact.copy()
    >>> mask[8:13, 40:43] = True
    >>> end_shift_px(exact, mask, np.array([30.0, 10.0]), np.array([39.5, 10.0]))
    3.0
    """
    way = tip_px - back_px
    reach = float(np.linalg.norm(way))
    if reach < 1:
        return None
    steps = np.arange(0, reach + BEYOND_PX, STEP_PX)
    line = back_px + steps[:, None] * way / reach
    u, v = np.floor(line + 0.5).astype(int).T
    inside = (u >= 0) & (u < exact.shape[1]) & (v >= 0) & (v < exact.shape[0])
    u, v = u[inside], v[inside]
    ends = []
    for picture in (exact, mask):
        seen = np.flatnonzero(picture[v, u])
        # The end shows if the outline crosses the line near the tip, not far short of it.
        if not len(seen) or steps[seen[-1]] < 0.5 * reach:
            return None
        ends.append(float(steps[seen[-1]]))
    return ends[1] - ends[0]
