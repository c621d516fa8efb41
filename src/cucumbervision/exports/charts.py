"""The figures behind the charts, the same in every file."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.agronomy.forecast import Forecast

__all__ = ["Charts", "class_days", "length_bins"]

_BIN_CM = 2


@dataclass(frozen=True)
class Charts:
    """What is drawn.

    Parameters
    ----------
    bins : tuple of (from_cm, to_cm, fruit)
        Histogram of the lengths on the plant.
    classes : tuple of str
        Classes of the forecast.
    days : tuple of (day, expected fruit in each class)
        The house's forecast.
    """

    bins: tuple[tuple[int, int, int], ...] = ()
    classes: tuple[str, ...] = ()
    days: tuple[tuple[int, tuple[float, ...]], ...] = ()


def length_bins(lengths_cm: Sequence[float]) -> tuple[tuple[int, int, int], ...]:
    """Count lengths in bins of 2 cm, from inclusive to exclusive, without gaps.

    Examples
    --------
    >>> length_bins([21.0, 22.0, 27.9])
    ((20, 22, 1), (22, 24, 1), (24, 26, 0), (26, 28, 1))
    """
    counts = Counter(math.floor(length / _BIN_CM) for length in lengths_cm)
    if not counts:
        return ()
    ends = range(min(counts), max(counts) + 1)
    return tuple((_BIN_CM * k, _BIN_CM * (k + 1), counts[k]) for k in ends)


def class_days(forecast: Forecast) -> tuple[tuple[int, tuple[float, ...]], ...]:
    """Give the house's expected fruit by day and class."""
    return tuple(
        (day, tuple(round(float(number), 2) for number in counts))
        for day, counts in zip(forecast.days.tolist(), forecast.house.expected, strict=True)
    )
