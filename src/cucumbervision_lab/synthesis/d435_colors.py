"""Transfer the colours of a RealSense D435 in a greenhouse to pictures of other cameras.

The D435 transmits some infrared and its white balance adapts little: leaves appear grey to pink,
especially bright ones, highlights are saturated, and shaded fruit are dark.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SEEN = np.array(
    [
        [47.5, -3.3, 11.4, 17.3, 6.5, 15.3],
        [46.4, -1.9, 9.9, 17.0, 5.7, 11.8],
        [38.1, 0.3, 3.4, 23.0, 6.4, 10.9],
        [47.7, -2.7, 8.4, 16.2, 8.5, 18.7],
        [48.5, -3.2, 10.3, 16.2, 8.3, 19.2],
        [52.0, -2.9, 9.2, 16.0, 8.5, 19.0],
    ]
)
"""Mean and standard deviation of L, a, b (CIELAB) of six captures in a greenhouse."""
_SPREAD = np.array([4.0, 2.0, 4.0, 2.0, 1.0, 2.0])
_LEAST_GAIN = np.array([0.6, 0.25, 0.25])
_MOST_GAIN = np.array([1.6, 1.3, 1.4])


def d435_colors(color: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a picture with the colours, noise and blur of a D435 in a greenhouse.

    Parameters
    ----------
    color : uint8 array, shape (height, width, 3)
        RGB.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    uint8 array, shape (height, width, 3)
        RGB.

    Examples
    --------
    >>> leaves = np.full((40, 60, 3), (60, 160, 40), np.uint8)
    >>> seen = d435_colors(leaves, np.random.default_rng(3))
    >>> bool(np.ptp(seen.mean((0, 1))) < np.ptp(leaves.mean((0, 1))))
    True
    """
    lab = cv2.cvtColor(color.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    first, second = _SEEN[rng.integers(len(_SEEN), size=2)]
    share = rng.random()
    wanted = first * (1 - share) + second * share + rng.normal(0, _SPREAD)
    spread = lab.reshape(-1, 3).std(0) + 1e-3
    gain = np.clip(wanted[3:] / spread, _LEAST_GAIN, _MOST_GAIN)
    lab = (lab - lab.reshape(-1, 3).mean(0)) * gain + wanted[:3]
    if rng.random() < 0.5:  # infrared makes bright leaves pink
        lab[..., 1] += np.clip((lab[..., 0] - 45) / 30, 0, 1) * rng.uniform(0, 8)
    if rng.random() < 0.35:
        lab[..., 0] *= rng.uniform(0.55, 0.9)
    seen = cv2.cvtColor(lab.astype(np.float32), cv2.COLOR_LAB2RGB)
    if rng.random() < 0.5:
        seen = np.where(seen > 0.6, 0.6 + (seen - 0.6) * rng.uniform(1.2, 1.6), seen)
    if rng.random() < 0.5:
        seen = cv2.GaussianBlur(seen, (0, 0), rng.uniform(0.4, 1.2) * max(seen.shape) / 900)
    noise = rng.normal(0, rng.uniform(0.004, 0.02), seen.shape)
    result: NDArray[np.uint8] = np.round(np.clip(seen + noise, 0, 1) * 255).astype(np.uint8)
    return result
