"""Assess the depth quality of a frame, with advice for the camera operator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.motion import still_px

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture

_NEAR_M, _FAR_M = 0.30, 1.00  # a D435 sees nothing under 0.28 m at 1280x720; noise grows as z²
_POOR_FILL = 0.60
NEAREST = 0.10
_STRIDE = 4


@dataclass(frozen=True)
class DepthQuality:
    """Quality of a frame's depth.

    Parameters
    ----------
    fill : float
        Share of valid readings in the centre of the picture, 0 to 1.
    distance_m : float, optional
        Distance of the nearest tenth of the centre, that is of the fruit, not the background.
    verdict : str
        'good', 'too-near', 'too-far', 'moving', 'poor' or 'none'.
    advice : str
        Advice to the operator.
    """

    fill: float
    distance_m: float | None
    verdict: str
    advice: str


def depth_quality(capture: Capture) -> DepthQuality:
    """Return the depth quality of a frame from its centre and the motion of the picture.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> def at(z):
    ...     color = np.zeros((48, 64, 3), np.uint8)
    ...     return depth_quality(Capture(color, np.full((48, 64), z, np.float32), camera, "a"))
    >>> at(0.5).verdict, at(0.2).verdict, at(1.4).verdict, at(0.0).verdict
    ('good', 'too-near', 'too-far', 'none')
    """
    height, width = capture.depth_m.shape
    middle = capture.depth_m[
        height // 6 : height - height // 6 : _STRIDE, width // 6 : width - width // 6 : _STRIDE
    ]
    valid = middle[valid_depth(middle)]
    fill = valid.size / middle.size
    if not valid.size:
        return DepthQuality(0.0, None, "none", "No depth: too near, or the lens is covered")
    distance_m = float(np.quantile(valid, NEAREST / 2))
    if distance_m < _NEAR_M:
        return DepthQuality(fill, distance_m, "too-near", "Too near: step back")
    if distance_m > _FAR_M:
        return DepthQuality(fill, distance_m, "too-far", "Too far: step closer")
    if capture.moved_px > still_px(capture.color):
        return DepthQuality(fill, distance_m, "moving", "The camera moves: hold still")
    if fill < _POOR_FILL:
        return DepthQuality(fill, distance_m, "poor", "Many holes: avoid glare, hold still")
    return DepthQuality(fill, distance_m, "good", "Good distance and depth")
