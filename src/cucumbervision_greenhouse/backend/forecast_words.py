"""What the pages say of growth, numbers of fruit and hours of work, with their intervals."""

from __future__ import annotations

import math
from datetime import date
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_greenhouse.backend.language import (
    counted,
    number_words,
)
from cucumbervision_greenhouse.backend.language import gettext as _
from cucumbervision_greenhouse.backend.round_words import date_words
from cucumbervision_greenhouse.rounds.forecasting import date_after
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S

if TYPE_CHECKING:
    from cucumbervision_greenhouse.agronomy.forecast import Forecast
    from cucumbervision_greenhouse.agronomy.growth import Growth
    from cucumbervision_greenhouse.agronomy.picking import Span
    from cucumbervision_greenhouse.backend.settings import Units

_FORECAST_Z = 1.2816  # half of an 80 % interval, in standard deviations


def daily_growth_words(growth_m_per_day: float | None, units: Units) -> str:
    """Return the growth of a day.

    Examples
    --------
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> daily_growth_words(0.0182, Units("cm")), daily_growth_words(None, Units("cm"))
    ('1.8 cm a day', '–')
    """
    growth = units.text(growth_m_per_day)
    return growth if growth_m_per_day is None else _("{growth} a day").format(growth=growth)


def span_words(span: Span) -> str:
    """Return a number of fruit with its interval, both whole.

    Examples
    --------
    >>> from cucumbervision_greenhouse.agronomy.picking import Span
    >>> span_words(Span(3.8, 3.0, 5.0)), span_words(Span(0.2, 0.0, 1.0)), span_words(Span(0, 0, 0))
    ('4 (3 to 5)', '0 to 1', '–')
    """
    if span.high < 0.5:
        return "–"
    if span.expected < 0.5:
        return _("{low} to {high}").format(low=0, high=f"{span.high:.0f}")
    words = f"{span.expected:.0f}"
    if span.low == span.high:
        return words
    ends = _("{low} to {high}").format(low=f"{span.low:.0f}", high=f"{span.high:.0f}")
    return f"{words} ({ends})"


def growth_words(growth: Growth, units: Units) -> str:
    """Return the growth that a forecast expects of its house in words, and where it comes from.

    Examples
    --------
    >>> from cucumbervision.agronomy.profiles import load_profile
    >>> from cucumbervision_greenhouse.agronomy.growth import GrowthPrior, Link, fit_growth
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> prior = GrowthPrior.of(load_profile("long-cucumber"))
    >>> growth_words(fit_growth([], prior), Units("cm"))
    'Expected growth: 3.0 cm a day (2.0 to 4.0), by the crop profile, as no fruit was seen on two
    days (2 to 4 cm a day: the CucumberVision paper, ...).'
    >>> links = [Link("a", "1", 0, 0.2, 0.003, 2, 0.28, 0.003)]
    >>> growth_words(fit_growth(links, prior), Units("in"))
    'Expected growth: 1.41 in a day (1.15 to 1.67), by 1 fruit seen on several days and the crop
    profile.'
    """
    low, mean, high = (
        max(growth.mean_m + z * growth.mean_sd_m, 0.0) for z in (-_FORECAST_Z, 0, _FORECAST_Z)
    )
    parts = {
        "growth": units.text(mean),
        "low": number_words(units.value(low) or 0.0, units.digits),
        "high": number_words(units.value(high) or 0.0, units.digits),
    }
    if count := len({link.fruit_id for link in growth.links}):
        return counted(
            count,
            "Expected growth: {growth} a day ({low} to {high}), by {n} fruit seen on several days "
            "and the crop profile.",
            "Expected growth: {growth} a day ({low} to {high}), by {n} fruit seen on several days "
            "and the crop profile.",
            **parts,
        )
    source = f" ({growth.prior.source})" if growth.prior.source else ""
    words = _(
        "Expected growth: {growth} a day ({low} to {high}), by the crop profile, as no fruit was "
        "seen on two days{source}."
    )
    return words.format(**parts, source=source)


def hours_words(hours: float) -> str:
    """Return hours of work; less than 1.5 hours as minutes, rounded up.

    Examples
    --------
    >>> hours_words(0.31), hours_words(3.24)
    ('19 min', '3.2 h')
    """
    if hours >= 1.5:
        return _("{hours} h").format(hours=number_words(hours, 1))
    return f"{math.ceil(60 * hours - 1e-9):d} min"


def hours_span_words(span: Span) -> str:
    """Return hours of work with their interval, each as in `hours_words`.

    Examples
    --------
    >>> from cucumbervision_greenhouse.agronomy.picking import Span
    >>> hours_span_words(Span(0.31, 0.2, 0.5)), hours_span_words(Span(3.24, 2.9, 4.0))
    ('19 min (12 min to 30 min)', '3.2 h (2.9 h to 4.0 h)')
    """
    lower, expected, upper = map(hours_words, (span.low, span.expected, span.high))
    if lower == upper:
        return expected
    return f"{expected} ({_('{low} to {high}').format(low=lower, high=upper)})"


def forecast_day(prediction: Forecast, day: int) -> str:
    """Return the name of a day of a forecast, counted from its day 0."""
    return date_words(date_after(prediction.today * DAY_S, day), date.today())


def first_days(prediction: Forecast) -> dict[str, int]:
    """Return the first day on which a fruit is expected in each class that is picked."""
    first = {}
    for k, name in enumerate(prediction.classes):
        (days,) = np.nonzero(prediction.house.expected[:, k] >= 1)
        if name in prediction.pick and len(days):
            first[name] = int(prediction.days[days[0]])
    return first


def expected_classes(prediction: Forecast) -> list[int]:
    """Return which classes any fruit may be in on any of the days."""
    return [k for k in range(len(prediction.classes)) if prediction.house.high[:, k].max() >= 1]
