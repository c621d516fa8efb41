"""A fruit as last measured, and draws of every fruit's length on the coming days."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ForecastError
from cucumbervision_greenhouse.agronomy.growth import (
    kalman_filter,
    measured_histories,
    measured_points,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision_greenhouse.agronomy.growth import (
        FilteredStates,
        Growth,
        Histories,
        Link,
        Spreads,
    )


@dataclass(frozen=True)
class FruitState:
    """The last measurement of one fruit.

    Parameters
    ----------
    fruit_id : str
        Fruit identifier, the same as in growth links.
    row : str
        Its row.
    position_m : float
        Along the row, metres.
    length_m, sd_m : float
        The length that the profile grades by, and its standard deviation, metres;
        `LengthBelief.sd_m` computes it from an interval.
    day : float
        Day of the measurement, counted as in the links.
    side : str
        Side of the row.
    best_class : str
        The best class that its shape allows, as `Grade.best_class` gives it; empty for any.
    picked : bool
        Whether it has been picked.
    possible : tuple of str
        The classes that it may be in on its day, as `Grade.possible` gives them; by default those
        that its 90 % interval spans.
    at_least : bool
        Whether the length is a lower bound.
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
    possible: tuple[str, ...] = ()
    at_least: bool = False


@dataclass(frozen=True, eq=False)
class LengthDraws:
    """Drawn lengths.

    Parameters
    ----------
    unslowed_m : ndarray of float32, shape (D, S, N)
        Unslowed lengths (`curve`) of N fruit on D days in S draws, metres.
    newcomer_m : ndarray of float64, shape (D, S)
        Unslowed growth from today on of a fruit in an unknown row, metres.
    """

    unslowed_m: NDArray[np.float32]
    newcomer_m: NDArray[np.float64]


def draw_lengths(
    fruit: Sequence[FruitState],
    growth: Growth,
    today: float,
    days: int,
    draws: int,
    scale_sd: float,
    rng: np.random.Generator,
) -> LengthDraws:
    """Draw the lengths of fruit on days 0 to `days`; lengths never shrink.

    Parameters
    ----------
    fruit : sequence of FruitState
        N fruit.
    growth : Growth
        The posterior.
    today : float
        Day 0; every fruit is extrapolated to it.
    days, draws : int
        Days ahead, and number of draws, rounded up to a multiple of the posterior's.
    scale_sd : float
        Relative standard deviation of an error common to all lengths.
    rng : numpy.random.Generator
        Random generator.

    Raises
    ------
    ForecastError
        If a fruit has links after its day, or was measured after `today`.
    """
    if late := [state for state in fruit if state.day > today]:
        raise ForecastError(
            f"fruit {late[0].fruit_id!r} was measured on day {late[0].day:g}, after today, day "
            f"{today:g}",
            remedy="give the day of the latest round as today",
        )
    histories = histories_of(fruit, growth, today, scale_sd)
    per_spread = -(-draws // len(growth.spreads))
    total = per_spread * len(growth.spreads)
    unslowed = np.empty((days + 1, total, len(fruit)), np.float32)
    newcomers = np.zeros((days + 1, total))
    [later] = rng.spawn(1)  # today's draws do not depend on the number of days
    for h, spreads in enumerate(growth.spreads):
        z = rng.standard_normal((per_spread, growth.basis.size))
        beta = growth.mean[h] + z @ growth.root[h].T
        unseen = len(histories.basis.rows) - len(growth.basis.rows)
        luck = spreads.row * rng.standard_normal((per_spread, unseen))
        beta = np.insert(beta, [1 + len(growth.basis.rows)] * unseen, luck, axis=1)
        weather = spreads.day * later.standard_normal((days, per_spread))
        shared = _Shared(beta, weather, len(histories.basis.rows))
        where = slice(h * per_spread, (h + 1) * per_spread)
        _fill(
            unslowed[:, where],
            kalman_filter(histories, spreads),
            shared,
            histories.row,
            spreads,
            (rng, later),
        )
        newcomers[1:, where] = _newcomers(shared, spreads, later)
    if scale_sd > 0:
        unslowed *= np.exp(scale_sd * rng.standard_normal((total, 1))).astype(np.float32)
    return LengthDraws(unslowed, newcomers)


def histories_of(
    fruit: Sequence[FruitState], growth: Growth, today: float, scale_sd: float
) -> Histories:
    """Arrange each fruit's points; rows without links follow those of the posterior."""
    links: dict[str, list[Link]] = {}
    for link in growth.links:
        links.setdefault(link.fruit_id, []).append(link)
    points = []
    for state in fruit:
        alone = max(state.sd_m**2 - (scale_sd * state.length_m) ** 2, (0.1 * state.sd_m) ** 2)
        past = measured_points(links[state.fruit_id]) if state.fruit_id in links else []
        if past and past[-1][0] > state.day:
            raise ForecastError(
                f"fruit {state.fruit_id!r} was measured on day {state.day:g}, a link of it ends "
                f"on day {past[-1][0]:g}",
                remedy="give the fruit as last measured, on the links' own count of days",
            )
        series = [*(p for p in past if p[0] < state.day), (state.day, state.length_m, alone**0.5)]
        points.append(growth.curve.points(series, growth.pace_m))
    names = [state.row for state in fruit]
    rows = tuple(dict.fromkeys((*growth.basis.rows, *names)))
    return measured_histories(points, names, replace(growth.basis, rows=rows), today)


@dataclass(frozen=True, eq=False)
class _Shared:
    """Effects shared in s draws: coefficients (s, p) of `rows` rows, next days (D, s)."""

    beta: NDArray[np.float64]
    days: NDArray[np.float64]
    row_count: int

    @property
    def rates(self) -> NDArray[np.float64]:
        """Growth of each row, shape (s, R)."""
        return self.beta[:, :1] + self.beta[:, 1 : 1 + self.row_count]


def _fill(
    lengths: NDArray[np.float32],
    filtered: FilteredStates,
    shared: _Shared,
    rows: NDArray[np.intp],
    spreads: Spreads,
    rngs: tuple[np.random.Generator, np.random.Generator],
) -> None:
    """Fill lengths, shape (D, s, N), of some draws: today's by one generator, later by another."""
    rng, later = rngs
    shape = lengths.shape[1:]
    var_x, cov, var_b = filtered.covariance.T
    sd_x = np.sqrt(var_x)
    slope = cov / sd_x
    residual_sd = np.sqrt(np.maximum(var_b - slope**2, 0.0))
    z = rng.standard_normal(shape, np.float32)
    length = _affine(filtered.length, shared.beta) + sd_x.astype(np.float32) * z
    rate = _affine(filtered.growth, shared.beta) + slope.astype(np.float32) * z
    rate += residual_sd.astype(np.float32) * rng.standard_normal(shape, np.float32)
    rate += shared.rates.astype(np.float32)[:, rows]
    lengths[0] = length
    for day in range(1, len(lengths)):
        step = later.standard_normal(shape, np.float32)
        step *= np.float32(spreads.fruit_day)
        step += rate
        step += shared.days[day - 1].astype(np.float32)[:, None]
        np.maximum(step, 0, out=step)
        np.add(lengths[day - 1], step, out=lengths[day])


def _affine(columns: NDArray[np.float64], beta: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return first column + others times beta for every draw, shape (s, N)."""
    result = np.repeat(columns[None, :, 0].astype(np.float32), len(beta), axis=0)
    # Only fruit with several points depend on beta. No BLAS: its threads cost more than they save.
    past = np.flatnonzero(columns[:, 1:].any(axis=1))
    weights = columns[past, 1:].astype(np.float32)
    result[:, past] += np.einsum("sp,np->sn", beta.astype(np.float32), weights)
    return result


def _newcomers(shared: _Shared, spreads: Spreads, rng: np.random.Generator) -> NDArray[np.float64]:
    own_rate = np.hypot(spreads.row, spreads.fruit) * rng.standard_normal(len(shared.beta))
    luck = spreads.fruit_day * rng.standard_normal(shared.days.shape)
    steps = np.maximum(shared.beta[:, 0] + own_rate + shared.days + luck, 0.0)
    return np.asarray(np.cumsum(steps, axis=0), np.float64)
