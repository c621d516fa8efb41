"""Traits of a fruit: those of its fitted tube, and those that plug in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import PluginError
from cucumbervision.methods.flags import Flag
from cucumbervision.plugins import Plugin
from cucumbervision.tube.curve import arc_positions
from cucumbervision.tube.shape import (
    axis_path,
    bending_direction,
    inner_arc_height,
    profile,
    thread_length,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.methods.result import Fruit, LengthDefinition
    from cucumbervision.protocols import Trait


_SMALLEST_RADIUS_M = 1e-4

# A spindle is thinner towards its ends than cucumbers are: mean over largest diameter. Its end may
# be out of sight beyond this angle along the view, the slope of its sides included.
_SPINDLE, _SPINDLE_END_DEG = 0.82, 55.0


@dataclass(frozen=True)
class TubeLengths:
    """The lengths of a fitted tube, metres: along its axis, over its outer side, end to end."""

    centreline_m: float
    thread_m: float
    chord_m: float

    def of(self, definition: LengthDefinition) -> float:
        """Return the length of that definition, metres."""
        value: float = getattr(self, f"{definition}_m")
        return value


@dataclass(frozen=True, eq=False, kw_only=True)
class TubeTraits:
    """Lengths and shape of one tube.

    Parameters
    ----------
    lengths : TubeLengths
        Centreline, thread and chord.
    inner_arc_m : float
        Largest distance from the chord (pole to pole) to the inner edge, metres; 0 where the
        inner edge does not rise above the chord.
    along_m, diameter_m : ndarray of float64, shape (101,)
        The diameter along the axis from pole to pole, metres.
    volume_m3 : float
        Cubic metres.
    tilt_deg : float
        Angle of the chord out of the picture plane, 0 to 90 degrees.
    axis_m : ndarray of float64, shape (K, 3)
        The axis from pole to pole, camera coordinates, metres.
    """

    lengths: TubeLengths
    inner_arc_m: float
    along_m: NDArray[np.float64]
    diameter_m: NDArray[np.float64]
    volume_m3: float
    tilt_deg: float
    axis_m: NDArray[np.float64]

    @property
    def inner_arc_mm_per_10cm(self) -> float:
        """Inner arc height in mm for each 10 cm of chord (UNECE FFV-15)."""
        return 100.0 * self.inner_arc_m / self.lengths.chord_m

    @property
    def diameter_max_m(self) -> float:
        """Largest diameter, metres."""
        return float(self.diameter_m.max())

    @property
    def diameter_mean_m(self) -> float:
        """Mean diameter along the axis from pole to pole, metres."""
        return float(np.trapezoid(self.diameter_m, self.along_m) / self.along_m[-1])

    @property
    def may_hide_an_end(self) -> bool:
        """Whether it is a spindle, as bananas are, with an end that points away from the camera.

        Such an end can lie behind the body's own middle: the tube fits what is seen well, and ends
        too early.
        """
        if self.diameter_mean_m > _SPINDLE * self.diameter_max_m:
            return False
        tenth, length_m = len(self.axis_m) // 10, self.along_m[-1]
        for axis, width in (
            (self.axis_m, self.diameter_m),
            (self.axis_m[::-1], self.diameter_m[::-1]),
        ):
            step = axis[0] - axis[tenth]
            sine = step @ axis[0] / np.linalg.norm(step) / np.linalg.norm(axis[0])
            away = np.arcsin(np.clip(sine, -1.0, 1.0))  # rounding, where an end is on the view
            slope = np.arctan((width[30] - width[10]) / 2 / (0.2 * length_m))
            if np.rad2deg(away + slope) > _SPINDLE_END_DEG:
                return True
        return False


def tube_traits(centres_m: NDArray[np.float64], radii_m: NDArray[np.float64]) -> TubeTraits:
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
class TraitValue:
    """The value of a trait, or why it is withheld.

    Parameters
    ----------
    value : float, optional
        In SI units; None where it is withheld.
    reason : str
        Why it is withheld, as a short code: 'too-few-pixels'.
    error : PluginError, optional
        Why another package's trait failed.
    """

    value: float | None
    reason: str = ""
    error: PluginError | None = None


@dataclass(frozen=True)
class TableTrait:
    """A trait: a function with the column that it fills; a `protocols.Trait`.

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
