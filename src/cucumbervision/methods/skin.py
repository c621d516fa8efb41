"""The share of a fruit's skin that has yellowed, by its colour: ripeness, and defects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.fruit.masks import box_of_mask, mask_window
from cucumbervision.methods.traits import TableTrait, TraitValue

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.methods.result import Fruit

YELLOW_DEG = (60.0, 105.0)
"""Hue of yellowed skin in CIELAB, degrees: green skin has 108 to 140, brown less than 60."""

_LEAST_CHROMA = 8.0  # of a colour: below it hue is the noise of grey
_LIGHTNESS = (10.0, 97.0)
_SATURATED = 250  # of 255: the sensor's own limit changes hue
_RIM_PX = 2  # where colours of fruit and background mix
_RIM = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
_LEAST_PX = 200
_LEAST_JUDGED = 0.5  # share of the skin whose colour can be judged
_SURROUNDINGS = 0.5  # of the box's size, on each side
_DOUBTED_SHARE = 0.3  # share from which yellow light is asked for: it makes all skin yellow
_CAST_SHARE = 0.85  # share of the surroundings with yellow hue: the light may be yellow


def yellow_share(color_rgb: NDArray[np.uint8], mask: NDArray[np.bool_]) -> TraitValue:
    """Compute the share of a fruit's visible skin that is yellow.

    Each pixel is judged by its hue in CIELAB, which shade and highlights hardly change. Pixels at
    the outline, in highlights, in the dark and without colour are left out.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture, sRGB, red first.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.

    Returns
    -------
    TraitValue
        0 to 1; withheld as 'too-few-pixels' (fewer than 200 inside the outline), 'no-colour',
        'overexposed' or 'too-dark' (where this is why less than half of the skin can be judged),
        and 'yellow-light' (skin and surroundings are yellow alike).

    Notes
    -----
    It knows the camera's colours only: a wrong white balance or coloured light shifts hue, and is
    noticed where everything else is yellow, too. It cannot tell ripeness from disease, sunburn or a
    yellow variety, nor see the far side.

    Examples
    --------
    Dark green skin, a quarter of which is yellow, before grey:

    >>> picture = np.full((80, 240, 3), 128, np.uint8)
    >>> picture[20:60, 20:220] = (40, 90, 30)
    >>> picture[20:60, 20:70] = (200, 180, 40)
    >>> mask = np.zeros((80, 240), bool)
    >>> mask[20:60, 20:220] = True
    >>> round(yellow_share(picture, mask).value, 2)
    0.24
    >>> yellow_share(np.full_like(picture, 128), mask).reason
    'no-colour'
    """
    window = mask_window(mask)
    if window is None:
        return TraitValue(None, "too-few-pixels")
    padded = cv2.copyMakeBorder(mask[window].astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    skin = cv2.erode(padded, _RIM)[1:-1, 1:-1] > 0
    if np.count_nonzero(skin) < _LEAST_PX:
        return TraitValue(None, "too-few-pixels")
    faults, yellow = _judge(color_rgb[window][skin])
    judged = ~np.logical_or.reduce([*faults.values()])
    if judged.mean() < _LEAST_JUDGED:
        return TraitValue(None, max(faults, key=lambda fault: faults[fault].mean()))
    share = float(yellow[judged].mean())
    if share > _DOUBTED_SHARE and _is_yellow_light(color_rgb, mask):
        return TraitValue(None, "yellow-light")
    return TraitValue(share)


def _judge(colors_rgb: NDArray[np.uint8]) -> tuple[dict[str, NDArray[np.bool_]], NDArray[np.bool_]]:
    """Return why colours, shape (N, 3), cannot be judged, by reason, and which have yellow hue."""
    lightness, chroma, hue_deg = _lightness_chroma_hue(colors_rgb)
    faults = {
        "overexposed": (colors_rgb.max(axis=1) >= _SATURATED) | (lightness > _LIGHTNESS[1]),
        "too-dark": lightness < _LIGHTNESS[0],
        "no-colour": chroma < _LEAST_CHROMA,
    }
    return faults, (hue_deg >= YELLOW_DEG[0]) & (hue_deg <= YELLOW_DEG[1])


def _is_yellow_light(color_rgb: NDArray[np.uint8], mask: NDArray[np.bool_]) -> bool:
    """Return whether the surroundings of a fruit are yellow, too."""
    part = _around(mask)
    color, fruit = color_rgb[part], mask[part]
    faults, yellow = _judge(color[cv2.dilate(fruit.astype(np.uint8), _RIM) == 0])
    judged = ~np.logical_or.reduce([*faults.values()])
    if np.count_nonzero(judged) < _LEAST_PX:
        return False
    share_judged = np.count_nonzero(judged) / np.count_nonzero(~fruit)
    return bool(share_judged * float(yellow[judged].mean()) > _CAST_SHARE)


def _around(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the part of the picture that holds a mask and its surroundings."""
    left, top, right, bottom = box_of_mask(mask)
    margin = _SURROUNDINGS * max(right - left, bottom - top)
    rows = slice(max(int(top - margin), 0), int(bottom + margin) + 1)
    return rows, slice(max(int(left - margin), 0), int(right + margin) + 1)


def _lightness_chroma_hue(
    colors_rgb: NDArray[np.uint8],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return lightness 0 to 100, chroma, and hue in degrees of CIELAB, each of shape (N,)."""
    lab = cv2.cvtColor(colors_rgb[:, None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    lightness, a, b = (lab[:, 0, channel].astype(np.float32) for channel in range(3))
    hue_deg = np.rad2deg(np.arctan2(b, a))
    return lightness, np.hypot(a, b).astype(np.float32), hue_deg.astype(np.float32)


def _of_fruit(capture: Capture, fruit: Fruit) -> TraitValue:
    if fruit.mask is None:
        return TraitValue(None, "no-mask")
    return yellow_share(capture.color, fruit.mask)


skin_yellow_share = TableTrait(
    name="skin_yellow_share",
    unit="",
    says="share of the visible skin that has yellowed, 0 to 1",
    function=_of_fruit,
)
