"""A fruit on the plant, as the forecast and the pick list need it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ForecastError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["FruitState", "check_fruit", "natural_key"]


@dataclass(frozen=True)
class FruitState:
    """One fruit, as it was last measured.

    Parameters
    ----------
    fruit_id : str
        The fruit; links of growth go by the same name.
    row : str
        Its row.
    position_m : float
        Along the row, metres.
    length_m, sd_m : float
        The length that the profile's classes are about, and its standard deviation, metres:
        `LengthBelief.sd_m` gives it from an interval.
    day : float
        When it was measured, on the same count of days as the links.
    side : str
        Side of the row.
    best_class : str
        The best class that its shape allows, as `Grade.best_class` gives it; empty for any.
    picked : bool
        Whether it has been picked.
    """

    fruit_id: str
    row: str
    position_m: float
    length_m: float
    sd_m: float
    day: float = 0.0
    side: str = ""
    best_class: str = ""
    picked: bool = False


def check_fruit(fruit: Sequence[FruitState], classes: Sequence[str]) -> None:
    """Refuse fruit that nothing can be forecast from.

    Raises
    ------
    ForecastError
        Naming the first fruit at fault: figures, `best_class`, or a name that two fruit have.
    """
    seen: set[str] = set()
    for one in fruit:
        figures = (one.length_m, one.sd_m, one.day, one.position_m)
        if not np.isfinite(figures).all() or one.length_m <= 0 or one.sd_m <= 0:
            raise ForecastError(
                f"fruit {one.fruit_id!r}: length {one.length_m} m, sd {one.sd_m} m, day {one.day}, "
                f"position {one.position_m} m",
                remedy="give finite figures, length and sd positive; leave unmeasured fruit out",
            )
        if one.best_class and one.best_class not in classes:
            raise ForecastError(
                f"fruit {one.fruit_id!r}: no class is called {one.best_class!r}",
                remedy=f"take one of {', '.join(classes)}",
            )
        if one.fruit_id in seen:
            raise ForecastError(
                f"two fruit are called {one.fruit_id!r}", remedy="give each fruit a name of its own"
            )
        seen.add(one.fruit_id)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts names as people do: row 2 before row 10.

    Examples
    --------
    >>> sorted(["row 10", "row 2", "A"], key=natural_key)
    ['A', 'row 2', 'row 10']
    """
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts)
