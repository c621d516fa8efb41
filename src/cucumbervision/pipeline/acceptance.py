"""Reject fruit of implausible size, and detect depth in a wrong unit."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.measurement.flags import Flag
from cucumbervision.measurement.result import Choice, Fruit, MethodName, Reason

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.capture.intrinsics import Intrinsics

_REFUSED = frozenset({Choice.IMPLAUSIBLE, Choice.IMPLAUSIBLE_DIAMETER})


def accepted_fruit(
    fruit: Fruit,
    lengths_m: tuple[float, float],
    diameters_m: tuple[float, float],
    intrinsics: Intrinsics,
) -> Fruit:
    """Return a fruit, without its length if the size is implausible for the crop.

    Parameters
    ----------
    fruit : Fruit
        The fruit with its length, a lower bound if it continues out of sight.
    lengths_m : tuple of float
        Shortest and longest, metres.
    diameters_m : tuple of float
        Least and largest mean diameter, metres.
    intrinsics : Intrinsics
        The camera, for the mean width of a mask whose tube was out of range.

    Returns
    -------
    Fruit
        If the size is outside the limits, nothing is selected, the reason is 'implausible-length'
        or 'implausible-diameter', and `fallback` ends with the rejected method. A fruit that is
        too large is flagged 'depth-unit'. The measurements of the methods are unchanged.
    """
    if fruit.length is None:
        return fruit
    length_m, diameter_m = fruit.length.value_m, _mean_diameter(fruit, intrinsics)
    large = length_m > lengths_m[1] or diameter_m > diameters_m[1]
    if length_m > lengths_m[1] or (length_m < lengths_m[0] and not fruit.at_least):
        reason = Choice.IMPLAUSIBLE
    elif large or diameter_m < diameters_m[0]:
        reason = Choice.IMPLAUSIBLE_DIAMETER
    else:
        return fruit
    tried = f"{fruit.method}:{Reason.OUT_OF_RANGE}"
    refused = replace(
        fruit,
        selected=None,
        reason=reason,
        fallback=(*fruit.fallback, tried),
        length=None,
        raw_length=None,
    )
    return refused.flagged(Flag.DEPTH_UNIT) if large else refused


def _mean_diameter(fruit: Fruit, intrinsics: Intrinsics) -> float:
    """Return the mean diameter, metres; NaN, which passes every limit, if it is unknown."""
    if fruit.traits is not None:
        return fruit.traits.diameter_mean_m
    tube = fruit.measurements.get(MethodName.M6)
    out = tube is not None and tube.reason is Reason.OUT_OF_RANGE
    if not out or fruit.mask is None or fruit.distance_m is None or fruit.length is None:
        return np.nan
    pixel_m2 = fruit.distance_m**2 / (intrinsics.fx_px * intrinsics.fy_px)
    return float(fruit.mask.sum() * pixel_m2 / fruit.length.value_m)


def with_unit_doubts(fruit: Sequence[Fruit]) -> tuple[Fruit, ...]:
    """Return the fruit of one picture, all flagged 'depth-unit' if half of them are too large.

    They share one depth picture: if its unit is wrong, fruit of plausible size are wrong, too.
    """
    is_sized = [measured.length is not None or measured.reason in _REFUSED for measured in fruit]
    large = sum(Flag.DEPTH_UNIT in measured.flags for measured in fruit)
    if not large or 2 * large < sum(is_sized):
        return tuple(fruit)
    return tuple(
        measured.flagged(Flag.DEPTH_UNIT) if sized else measured
        for measured, sized in zip(fruit, is_sized, strict=True)
    )
