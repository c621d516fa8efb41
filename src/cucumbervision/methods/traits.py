"""Traits of a fruit: those of its fitted tube, and those that plug in."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cucumbervision.arrays import Array, Array32, Mask, Pixels
from cucumbervision.capture.frames import Capture
from cucumbervision.errors import PluginError
from cucumbervision.fruit.masks import box_of_mask, mask_window
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import Fruit, TraitValue, TubeLengths, TubeTraits
from cucumbervision.methods.table import Trait
from cucumbervision.plugins import Plugin
from cucumbervision.tube.shape import (
    arc_positions,
    axis_path,
    bending_direction,
    inner_arc_height,
    profile,
    thread_length,
)

_SMALLEST_RADIUS_M = 1e-4


def tube_traits(centres_m: Array, radii_m: Array) -> TubeTraits:
    """Compute the traits of a body of balls along a curve.

    Parameters
    ----------
    centres_m : ndarray of float64, shape (K, 3)
        Centres in order, camera coordinates, metres.
    radii_m : ndarray of float64, shape (K,)
        Their radii.

    Returns
    -------
    TubeTraits
        Of the balls' union.

    Examples
    --------
    A cylinder of radius 2 cm with round ends, its centres 16 cm long:

    >>> x = np.linspace(0, 0.16, 161)
    >>> traits = tube_traits(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), np.full(161, 0.02))
    >>> round(traits.lengths.centreline_m, 4), round(traits.lengths.thread_m, 4)
    (0.2, 0.2)
    >>> by_hand = np.pi * 0.02**2 * 0.16 + 4 / 3 * np.pi * 0.02**3
    >>> round(1e6 * traits.volume_m3, 1), round(1e6 * by_hand, 1)  # millilitres
    (234.5, 234.6)
    >>> round(traits.diameter_max_m, 4), round(traits.tilt_deg, 1), traits.inner_arc_m
    (0.04, 0.0, 0.0)
    """
    radii = np.maximum(radii_m, _SMALLEST_RADIUS_M)
    axis = axis_path(centres_m, radii)
    outward = bending_direction(axis)
    ends = axis[[0, -1]]
    chord = float(np.linalg.norm(ends[1] - ends[0]))
    along, diameter = profile(centres_m, radii)
    lengths = TubeLengths(
        centreline_m=float(arc_positions(axis)[-1]),
        thread_m=thread_length(centres_m, radii, outward),
        chord_m=chord,
    )
    deep = abs(float(ends[1, 2] - ends[0, 2])) / max(chord, 1e-9)
    return TubeTraits(
        lengths=lengths,
        inner_arc_m=inner_arc_height(centres_m, radii, ends, outward),
        along_m=along,
        diameter_m=diameter,
        volume_m3=float(np.trapezoid(np.pi / 4 * diameter**2, along)),
        tilt_deg=float(np.rad2deg(np.arcsin(np.clip(deep, -1.0, 1.0)))),
        axis_m=axis,
    )


@dataclass(frozen=True)
class TableTrait:
    """A trait: a function with the column that it fills; a `Trait`.

    Parameters
    ----------
    name, unit, says : str
        Of the column.
    function : callable
        Takes a capture and a fruit; returns the value in SI units, None or a `TraitValue`.

    Examples
    --------
    >>> bend = TableTrait("tube_ends", "", "ends of a tube", lambda capture, fruit: 2.0)
    >>> bend(None, None)
    2.0
    """

    name: str
    unit: str
    says: str
    function: Callable[[Capture, Fruit], float | TraitValue | None]

    def __call__(self, capture: Capture, fruit: Fruit, /) -> float | TraitValue | None:
        """Return the value of a fruit."""
        return self.function(capture, fruit)


def with_traits(capture: Capture, fruit: Fruit, traits: Iterable[tuple[Plugin, Trait]]) -> Fruit:
    """Return a fruit with the values of traits.

    Parameters
    ----------
    capture : Capture
        The frame.
    fruit : Fruit
        The fruit.
    traits : iterable of (Plugin, Trait)
        Each with its line of the table.

    Returns
    -------
    Fruit
        A trait of another package that raised, or returned what is no finite number, has the reason
        'plugin-failed' and the error; the fruit is flagged, and otherwise as it was.
    """
    values = {plugin.name: trait_value(plugin, trait, capture, fruit) for plugin, trait in traits}
    if not values:
        return fruit
    fruit = replace(fruit, trait_values={**fruit.trait_values, **values})
    failed = any(value.error is not None for value in values.values())
    return fruit.flagged(Flag.PLUGIN_FAILED) if failed else fruit


def trait_value(plugin: Plugin, trait: Trait, capture: Capture, fruit: Fruit) -> TraitValue:
    """Return the value of a trait; what fails is a value with an error."""
    try:
        answer = plugin.call(trait, capture, fruit)
        value = answer if isinstance(answer, TraitValue) else TraitValue(answer)
        if value.value is None:
            return value
        number = plugin.call(float, value.value)
        if not math.isfinite(number):
            raise plugin.error(f"returned {number} in place of a finite number")
        return replace(value, value=number)
    except PluginError as error:
        return TraitValue(None, str(Flag.PLUGIN_FAILED), error)


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


def yellow_share(color_rgb: Pixels, mask: Mask) -> TraitValue:
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


def _judge(colors_rgb: Pixels) -> tuple[dict[str, Mask], Mask]:
    """Return why colours, shape (N, 3), cannot be judged, by reason, and which have yellow hue."""
    lightness, chroma, hue_deg = _lightness_chroma_hue(colors_rgb)
    faults = {
        "overexposed": (colors_rgb.max(axis=1) >= _SATURATED) | (lightness > _LIGHTNESS[1]),
        "too-dark": lightness < _LIGHTNESS[0],
        "no-colour": chroma < _LEAST_CHROMA,
    }
    return faults, (hue_deg >= YELLOW_DEG[0]) & (hue_deg <= YELLOW_DEG[1])


def _is_yellow_light(color_rgb: Pixels, mask: Mask) -> bool:
    """Return whether the surroundings of a fruit are yellow, too."""
    part = _around(mask)
    color, fruit = color_rgb[part], mask[part]
    faults, yellow = _judge(color[cv2.dilate(fruit.astype(np.uint8), _RIM) == 0])
    judged = ~np.logical_or.reduce([*faults.values()])
    if np.count_nonzero(judged) < _LEAST_PX:
        return False
    share_judged = np.count_nonzero(judged) / np.count_nonzero(~fruit)
    return bool(share_judged * float(yellow[judged].mean()) > _CAST_SHARE)


def _around(mask: Mask) -> tuple[slice, slice]:
    """Return the part of the picture that holds a mask and its surroundings."""
    left, top, right, bottom = box_of_mask(mask)
    margin = _SURROUNDINGS * max(right - left, bottom - top)
    rows = slice(max(int(top - margin), 0), int(bottom + margin) + 1)
    return rows, slice(max(int(left - margin), 0), int(right + margin) + 1)


def _lightness_chroma_hue(colors_rgb: Pixels) -> tuple[Array32, Array32, Array32]:
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
