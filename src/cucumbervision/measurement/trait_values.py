"""Traits that plug in: values with their units, each computed once for a measured fruit."""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from cucumbervision.errors import PluginError
from cucumbervision.measurement.flags import Flag
from cucumbervision.plugins import Plugin

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.result import Fruit
    from cucumbervision.protocols import Trait


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
    capture = capture.read_only()  # else a trait changes the fruit after it
    values = {plugin.name: trait_value(plugin, trait, capture, fruit) for plugin, trait in traits}
    if not values:
        return fruit
    fruit = replace(fruit, trait_values={**fruit.trait_values, **values})
    failed = any(value.error is not None for value in values.values())
    return fruit.flagged(Flag.PLUGIN_FAILED) if failed else fruit


def trait_value(plugin: Plugin, trait: Trait, capture: Capture, fruit: Fruit) -> TraitValue:
    """Return the value of a trait; what fails is a value with an error."""
    try:
        return _checked(plugin, plugin.call(trait, capture, fruit))
    except PluginError as error:
        return TraitValue(None, str(Flag.PLUGIN_FAILED), error)


def _checked(plugin: Plugin, answer: Any) -> TraitValue:
    value = answer if isinstance(answer, TraitValue) else TraitValue(answer)
    number = value.value
    if number is None:
        return value
    answer = cast("Any", number)  # a trait of another package may return anything
    is_real = isinstance(answer, (float, int, np.floating, np.integer))
    try:
        figure = float(answer) if is_real and not isinstance(answer, np.timedelta64) else math.nan
    except OverflowError:
        figure = math.inf
    if not math.isfinite(figure):
        raise plugin.error(f"returned {reprlib.repr(number)} in place of a finite number")
    return replace(value, value=figure)
