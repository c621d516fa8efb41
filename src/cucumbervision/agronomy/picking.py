"""Which fruit to pick today, in the order in which they are walked past."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cucumbervision.agronomy.fruit import natural_key
from cucumbervision.agronomy.profiles import TOO_LONG
from cucumbervision.errors import ForecastError

if TYPE_CHECKING:
    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.fruit import FruitState

__all__ = ["Pick", "pick_list"]


@dataclass(frozen=True)
class Pick:
    """One fruit of the pick list.

    Parameters
    ----------
    fruit : FruitState
        Row, side, position and length.
    name : str
        Its likeliest class today, or 'too long': to be taken off before it costs others growth.
    ready : float
        Probability to be in a class that is picked.
    """

    fruit: FruitState
    name: str
    ready: float


def pick_list(
    forecast: Forecast, threshold: float = 0.5, *, back_and_forth: bool = True
) -> tuple[Pick, ...]:
    """Give today's ready fruit by row and position.

    Parameters
    ----------
    forecast : Forecast
        Whose day 0 is today; fruit marked picked are not in it.
    threshold : float
        Fruit at least this probable to be ready, or to be too long, are listed.
    back_and_forth : bool
        Walk every second row from its far end, so that no way is walked twice. A row's sides are
        walked together, as fruit of both hang along one path.

    Raises
    ------
    ForecastError
        If the threshold is no probability.

    Examples
    --------
    >>> from cucumbervision.agronomy.forecast import FruitState, forecast
    >>> from cucumbervision.agronomy.growth import GrowthPrior, fit_growth
    >>> from cucumbervision.agronomy.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> at = [("2", 4.0, 0.28), ("2", 9.0, 0.30), ("1", 3.0, 0.27), ("1", 5.0, 0.22)]
    >>> fruit = [FruitState(f"{row}-{x}", row, x, length, 0.004) for row, x, length in at]
    >>> found = forecast(fruit, fit_growth([], GrowthPrior.of(profile)), profile)
    >>> [(pick.fruit.row, pick.fruit.position_m, pick.name) for pick in pick_list(found)]
    [('1', 3.0, 'I'), ('2', 9.0, 'I'), ('2', 4.0, 'I')]
    """
    if not 0 < threshold <= 1:
        raise ForecastError(
            f"the threshold is {threshold}", remedy="give a probability above 0, at most 1"
        )
    too_long = forecast.classes.index(TOO_LONG)
    listed = []
    for one, ready, chances in zip(
        forecast.fruit, forecast.ready, forecast.probability[:, 0], strict=True
    ):
        if max(ready, chances[too_long]) >= threshold:
            listed.append(Pick(one, forecast.classes[int(chances.argmax())], float(ready)))
    rows = sorted({pick.fruit.row for pick in listed}, key=natural_key)
    ways = {row: -1 if back_and_forth and k % 2 else 1 for k, row in enumerate(rows)}
    return tuple(
        sorted(
            listed,
            key=lambda pick: (
                natural_key(pick.fruit.row),
                ways[pick.fruit.row] * pick.fruit.position_m,
                pick.fruit.side,
                pick.fruit.fruit_id,
            ),
        )
    )
