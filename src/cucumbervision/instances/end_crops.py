"""The picture around each end of a fruit, and what it looks like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.curve import arc_positions
from cucumbervision.instances.turned_crops import crop_places, crop_planes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics


END_PX = 64
"""Height and width of a crop."""

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Levels of `EndLook.missing`."""

_RADII = 8.0  # side of a crop
_INNER_RADII = 1.5  # the direction of an end is that of the axis this far inside
_LEAST_RADIUS_PX = 1.0


@dataclass(frozen=True)
class EndLook:
    """Evaluation of one end of a fruit.

    Parameters
    ----------
    true, covered, running_on : float
        Probabilities, with the sum 1: the fruit ends there; more than 5 % of its length is missing
        (covered, or outside the picture); the measured axis extends beyond the fruit by as much,
        into a stem, a flower or a leaf.
    missing : tuple of float, length 5
        Quantiles (`QUANTILES`) of the missing length, relative to the fruit's length; negative if
        too much was measured.
    stem : float
        Probability that it is the stem end.
    """

    true: float
    covered: float
    running_on: float
    missing: tuple[float, ...]
    stem: float


@dataclass(frozen=True, eq=False)
class EndCrop:
    """The picture around one end of a fruit.

    Parameters
    ----------
    planes : ndarray of uint8, shape (64, 64, 6)
        See `PLANES`. The end is in the middle, the fruit comes from the left.
    shape : tuple of float
        Length over radius, and radius in pixels, both as logarithms.
    """

    planes: NDArray[np.uint8]
    shape: tuple[float, float]


def end_crop(
    color_rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    mask: NDArray[np.bool_],
    intrinsics: Intrinsics,
    axis_m: NDArray[np.float64],
    diameter_m: float,
) -> EndCrop:
    """Cut out the picture around the first point of a fruit's axis.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.
    axis_m : ndarray of float64, shape (K, 3)
        The measured axis, from the end of the crop to the other end, camera coordinates.
    diameter_m : float
        The fruit's largest diameter, metres.

    Examples
    --------
    A green fruit of 4 cm before a wall, 0.5 m away; its right end is in the middle of the crop:

    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> mask = np.zeros((480, 640), bool)
    >>> mask[216:265, 200:321] = True
    >>> color = np.where(mask[..., None], (40, 140, 40), (90, 90, 90)).astype(np.uint8)
    >>> depth = np.where(mask, 0.5, 1.0).astype(np.float32)
    >>> axis = np.stack([np.linspace(0, -0.1, 9), np.zeros(9), np.full(9, 0.52)], axis=1)
    >>> crop = end_crop(color, depth, mask, camera, axis, 0.04)
    >>> crop.planes[32, [13, 51], 1].tolist(), crop.planes[32, [13, 51], 5].tolist()
    ([140, 90], [255, 0])
    >>> crop.planes[32, [13, 51], 3].tolist()  # at the fruit's surface, far behind it
    [128, 255]
    """
    radius_m = max(diameter_m / 2, 1e-3)
    run = arc_positions(axis_m)
    inner = axis_m[min(int(np.searchsorted(run, _INNER_RADII * radius_m)), len(axis_m) - 1)]
    tip_px, inner_px, far_px = intrinsics.project(np.stack([axis_m[0], inner, axis_m[-1]]))
    radius_px = max(radius_m * intrinsics.fx_px / float(axis_m[0, 2]), _LEAST_RADIUS_PX)
    ahead = _direction(tip_px - inner_px, tip_px - far_px)
    step_px = _RADII * radius_px / END_PX
    places_px = crop_places(tip_px, ahead, step_px, (END_PX, END_PX))
    surface_m = float(inner[2]) - radius_m
    planes = crop_planes(color_rgb, depth_m, mask, places_px, step_px, surface_m, radius_m)
    length_m = max(float(run[-1]), 1e-3)
    return EndCrop(planes, (float(np.log(length_m / radius_m)), float(np.log(radius_px))))


def _direction(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a unit vector along the first of two vectors that is not zero."""
    for vector in (first, second):
        norm = float(np.linalg.norm(vector))
        if norm > 1e-3:
            return np.asarray(vector / norm)
    return np.array([1.0, 0.0])
