"""What forecasts real harvests, and how the forecast does in houses that grow at their rates.

A folder holds `X_daily.csv` and `X_weekly.csv` of several compartments X under one sky, with the
columns of the Autonomous Greenhouse Challenge 2018 (Hemming et al., Sensors 19(8) 1807) as read
below. Each compartment is forecast from its own days before, and from figures of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cucumbervision.accuracy.statistics import ReportTable
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import DataSetError, wrap_reader_errors
from cucumbervision_greenhouse.forecast.forecast import Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import (
    FruitState,
    GrowthPrior,
    Spreads,
    fit_growth,
    rate_share,
)
from cucumbervision_lab.arrays import Array, Generator

PROFILE = load_profile("long-cucumber")
NAIVE_M_PER_DAY = 0.03
_GROWN_CM = 30  # by which a cucumber grows from flower to harvest
_FRUIT = ["class_a_fruit_per_m2", "class_b_fruit_per_m2"]
_CLIMATE = ["air_mean_c", "outside_radiation_mj_per_m2"]
_WORTH = (0, 6, 12, 24, 48)  # open days for which the seasons of the neighbours may count
_AIR_DAYS, _LOAD_DAYS = 20, 14


@dataclass(frozen=True, eq=False)
class Compartment:
    """What was picked in a compartment.

    Parameters
    ----------
    name : str
        Its name.
    daily : DataFrame
        A row a day: `fruit` picked per m², whether it was `open` for picking, and the climate.
    ripe : Series
        Days from flower to harvest, by the last day of each week.
    """

    name: str
    daily: pd.DataFrame
    ripe: pd.Series[float]

    @property
    def first(self) -> int:
        """The day of the first pick."""
        return int((self.daily["fruit"] > 0).to_numpy().argmax())

    def starts(self, days: int) -> NDArray[np.intp]:
        """Return the days from which so many days are forecast."""
        return np.arange(self.first + 7, len(self.daily) - days + 1)

    def sums(self, column: str, start: NDArray[np.intp] | int, stop: NDArray[np.intp]) -> Array:
        """Return the sums of a column from `start` to before `stop`."""
        running = np.concatenate([[0.0], self.daily[column].cumsum()])
        return np.asarray(running[stop] - running[start])


def read_compartment(path: Path) -> Compartment:
    """Read the two files of a compartment.

    Raises
    ------
    DataSetError
        If a file or a column is missing.
    """
    name = path.name.partition("_")[0]
    with wrap_reader_errors(path, DataSetError, "give the files as the documentation says"):
        daily = pd.read_csv(path, parse_dates=["date"])
        weeks = pd.read_csv(path.with_name(f"{name}_weekly.csv"))
        weeks = weeks.dropna(subset="days_from_flower_to_harvest").set_index("iso_week")
        dates = daily["date"].dt.isocalendar()
        daily["fruit"], daily["open"] = daily[_FRUIT].sum(axis=1), dates["day"] < 7
        daily[_CLIMATE] = daily[_CLIMATE].interpolate(limit_direction="both")
        last = pd.Series(daily.index, dates["week"]).groupby(level=0).max()
        ripe = weeks["days_from_flower_to_harvest"].astype(float)
        return Compartment(name, daily, ripe.set_axis(last[ripe.index]))


def true_picks(house: Compartment, _: Sequence[Compartment], days: int) -> Array:
    """Return what was picked in the next days, from each day that is forecast."""
    start = house.starts(days)
    return house.sums("fruit", start, start + days)


def _last_week(house: Compartment, _: Sequence[Compartment], days: int) -> Array:
    start = house.starts(days)
    return house.sums("fruit", start - 7, start) / 7 * days


def rate_so_far(
    house: Compartment, neighbours: Sequence[Compartment], days: int, worth: int = 0
) -> Array:
    """Forecast picks by the rate since the first one, and so many days of the others' seasons."""
    start, seasons = (
        house.starts(days),
        [neighbour.daily[neighbour.first :] for neighbour in neighbours],
    )
    season = np.mean(
        [compartment["fruit"].sum() / compartment["open"].sum() for compartment in seasons]
    )
    picked = house.sums("fruit", 0, start) + worth * season
    rate = picked / (house.sums("open", house.first, start) + worth)
    return np.asarray(rate * house.sums("open", start, start + days))


def _by_seasons(house: Compartment, neighbours: Sequence[Compartment], days: int) -> Array:
    def error(worth: int) -> float:
        held_pairs = (
            (neighbour, [x for x in neighbours if x is not neighbour]) for neighbour in neighbours
        )
        gaps = (rate_so_far(*pair, days, worth) - true_picks(*pair, days) for pair in held_pairs)
        return float(sum(np.abs(gap).sum() for gap in gaps))

    return rate_so_far(house, neighbours, days, min(_WORTH, key=error))


def _by_climate(
    house: Compartment, neighbours: Sequence[Compartment], days: int, *, ahead: bool = False
) -> Array:
    def features(compartment: Compartment) -> Array:
        start = compartment.starts(days)
        window = (start, start + days) if ahead else (start - 7, start)
        climate = [compartment.sums(name, *window) / (days if ahead else 7) for name in _CLIMATE]
        rate = rate_so_far(compartment, neighbours, days)
        return np.column_stack([rate, *(rate * values for values in climate)])

    columns = np.concatenate([features(neighbour) for neighbour in neighbours])
    fit = np.linalg.lstsq(columns, np.concatenate([true_picks(o, (), days) for o in neighbours]))[0]
    return np.asarray(features(house) @ fit)


_Method = Callable[[Compartment, Sequence[Compartment], int], Array]
_METHODS: dict[str, tuple[_Method, str]] = {
    "last week's rate": (_last_week, "nothing"),
    "own rate since the first pick": (rate_so_far, "that nobody picks on Sundays"),
    "with the seasons of the others": (_by_seasons, "their weight, on the others alone"),
    "with climate up to the day": (_by_climate, "fitted to the others"),
    "with climate of the days ahead": (partial(_by_climate, ahead=True), "fitted to the others"),
}


def picks_table(houses: Sequence[Compartment]) -> ReportTable:
    """Return the error of the forecasts of picks: of all compartments, and of each."""
    rows = []
    for days in (1, 3, 7):
        for name, (method, chosen) in _METHODS.items():
            sums = []
            for house in houses:
                neighbours = [neighbour for neighbour in houses if neighbour is not house]
                true = true_picks(house, neighbours, days)
                sums.append((np.abs(method(house, neighbours, days) - true).sum(), true.sum()))
            wrong, picked = np.transpose([np.sum(sums, axis=0), *sums])
            rows.append((days, name, *(100 * wrong / picked), chosen))
    names = [f"{house.name}:.1" for house in houses]
    comment = (
        "Weighted absolute error in %, each compartment left out. Aims: 30 % for 3 days, 20 % for "
        "7. Seasons and fits of the others are of the same weeks under the same sky, which nobody "
        "has beforehand; only the first two need nothing of them."
    )
    heads = ["days ahead", "picks by", "all:.1", *names, "chosen on these harvests"]
    return ReportTable.of("Picks of the next days", heads, rows, comment)


def _ripening(house: Compartment, *, to_harvest: bool) -> tuple[Array, Array]:
    """Return what is known of each week, beside 1, and the logarithm of the days it took."""
    rows = []
    for day, took in house.ripe.items():
        end = int(day) + 1 if to_harvest else max(int(day - took) + 1, 1)
        air_c = house.daily["air_mean_c"][max(end - _AIR_DAYS - 1, 0) : end].mean()
        rows.append([1.0, air_c, house.daily["fruit"][max(end - _LOAD_DAYS, 0) : end].mean()])
    return np.array(rows), np.log(house.ripe.to_numpy())


def ripening_table(houses: Sequence[Compartment]) -> ReportTable:
    """Return the median error of the days from flower to harvest, each compartment left out."""
    rows = []
    for name, columns, to_harvest in (
        ("a constant", 1, True),
        ("air and fruit load, known up to the harvest", 3, True),
        ("air and fruit load, up to the flower", 3, False),
    ):
        parts = [_ripening(house, to_harvest=to_harvest) for house in houses]
        errors = []
        for k, (left_out, true) in enumerate(parts):
            features, took = zip(*(part for i, part in enumerate(parts) if i != k), strict=True)
            fit = np.linalg.lstsq(np.concatenate(features)[:, :columns], np.concatenate(took))[0]
            errors.append(np.abs(np.exp(left_out[:, :columns] @ fit) - np.exp(true)))
        rows.append((name, *(float(np.median(e)) for e in (np.concatenate(errors), *errors))))
    comment = (
        f"Aim: 1.5 days. The mean air temperature of {_AIR_DAYS} days and the picks of "
        f"{_LOAD_DAYS}: both windows were chosen on these harvests."
    )
    heads = ["days from flower to harvest by, median error", "all", *(h.name for h in houses)]
    return ReportTable.of("Days from flower to harvest", heads, rows, comment)


_ROWS, _FRUIT_PER_ROW = 10, 100  # those too small to be measured included
_VISITS, _DAYS = (-4, -2, 0), 7  # days of the rounds, the last is today; days ahead
_YOUNGEST_M, _OLDEST_M, _SHORTEST_M = -0.30, 0.33, 0.05  # today; below 0 a fruit is yet to set
_RELATIVE_SD, _FLOOR_SD_M = 0.02, 0.002  # measuring error: a share of the length, and a floor


@dataclass(frozen=True)
class HouseSettings:
    """What to simulate.

    Parameters
    ----------
    mean_m : float
        Growth of this very house, metres a day; `spreads.house` is not used.
    spreads : Spreads
        Between rows, fruit, days, and a fruit's days; metres a day.
    links : int
        Fruit whose earlier lengths the forecast gets to see, at most; chosen at random.
    found_share : float
        Share of fruit that a round finds.
    full_m : float
        The length at which growth would stop, as in `Curve`. Infinite: it does not slow.
    """

    mean_m: float
    spreads: Spreads
    links: int = 500
    found_share: float = 0.95
    full_m: float = float("inf")


@dataclass(frozen=True, eq=False)
class SimulatedHouse:
    """A house: what was measured, and what is true.

    Parameters
    ----------
    fruit : tuple of FruitState
        As found today.
    lengths_m : ndarray of float64, shape (D, N)
        True lengths of all N fruit today and later.
    of_fruit : ndarray of int64, shape (len(fruit),)
        The true fruit behind each found one.
    """

    fruit: tuple[FruitState, ...]
    lengths_m: Array
    of_fruit: NDArray[np.int64]


def simulate_house(settings: HouseSettings, seed: int) -> SimulatedHouse:
    """Simulate a house.

    Examples
    --------
    >>> spreads = Spreads(0.006, 0.002, 0.005, 0.003, 0.003)
    >>> house = simulate_house(HouseSettings(0.03, spreads, links=20), seed=1)
    >>> house.lengths_m.shape, sum(bool(fruit.earlier) for fruit in house.fruit)
    ((8, 1000), 20)
    """
    rng, spreads = np.random.default_rng(seed), settings.spreads
    row = np.repeat(np.arange(_ROWS), _FRUIT_PER_ROW)
    of_rows, of_fruit = rng.standard_normal(_ROWS)[row], rng.standard_normal(len(row))
    rate = settings.mean_m + spreads.row * of_rows + spreads.fruit * of_fruit
    lengths = {0: rng.uniform(_YOUNGEST_M, _OLDEST_M, len(row))}
    steps = [(day, 1) for day in range(_DAYS)] + [(day, -1) for day in range(0, min(_VISITS), -1)]
    for day, way in steps:
        luck = spreads.fruit_day * rng.standard_normal(len(row))
        step = np.maximum(rate + spreads.day * rng.standard_normal() + luck, 0.0)
        # The day's growth at the length of its middle, forwards and backwards alike.
        middle = lengths[day] + way * step * rate_share(lengths[day], settings.full_m) / 2
        lengths[day + way] = lengths[day] + way * step * rate_share(middle, settings.full_m)
    rng.standard_normal()  # earlier versions drew an error of all lengths: the same houses again
    rounds = {day: _measured(settings, lengths[day], rng) for day in _VISITS}
    read, before = rounds[0], np.array([rounds[day] for day in _VISITS[:-1]])
    visible = np.flatnonzero(~np.isnan(read))
    linked = visible[~np.isnan(before[:, visible]).all(axis=0)]
    with_past = set(rng.permutation(linked)[: settings.links].tolist())
    states = []
    for true in visible.tolist():
        earlier = zip(_VISITS[:-1], before[:, true].tolist(), strict=True)
        earlier_lengths = tuple(
            (day, x, _sd(x)) for day, x in earlier if true in with_past and x > 0
        )
        position_m, length_m = round(float(rng.uniform(0, 50)), 2), float(read[true])
        place = str(true), str(row[true]), position_m
        states.append(FruitState(*place, length_m, _sd(length_m), earlier=earlier_lengths))
    truth = np.stack([lengths[day] for day in range(_DAYS + 1)])
    return SimulatedHouse(tuple(states), truth, visible)


def _measured(settings: HouseSettings, length_m: Array, rng: Generator) -> Array:
    """Return measured lengths, NaN where the fruit was missed or is too small."""
    sd = np.hypot(_RELATIVE_SD * length_m, _FLOOR_SD_M)
    read = length_m + sd * rng.standard_normal(len(length_m))
    visible = (rng.random(len(length_m)) < settings.found_share) & (read >= _SHORTEST_M)
    return np.where(visible, read, np.nan)


def _sd(read_m: float) -> float:
    """Return the standard deviation of a measured length, as its interval has it."""
    return float(np.hypot(_RELATIVE_SD * read_m, _FLOOR_SD_M))


@dataclass(frozen=True)
class Scenario:
    """Houses of one kind; None draws the house's mean growth from the prior."""

    name: str
    links: int
    mean_cm: float | None = None
    full_m: float = float("inf")
    found_share: float = 1.0


def classes_of(lengths_m: Array) -> NDArray[np.intp]:
    """Return the index of each length's class among the profile's outcomes."""
    bins = np.searchsorted(PROFILE.edges_m, lengths_m, side="right")
    return np.array(PROFILE.outcome_of_bin, np.intp)[bins]


def run_house(scenario: Scenario, seed: int) -> tuple[float, ...]:
    """Simulate a house, forecast it and compare both."""
    rng = np.random.default_rng([7, seed])
    prior = GrowthPrior.of(PROFILE)
    # How far the true spreads are from the profile's.
    row, fruit, day, fruit_day = np.exp(0.35 * rng.standard_normal(4))
    p = prior.spreads
    spreads = Spreads(p.house, p.row * row, p.fruit * fruit, p.day * day, p.fruit_day * fruit_day)
    drawn = prior.mean_m + p.house * rng.standard_normal()
    mean = max(drawn, 0.005) if scenario.mean_cm is None else scenario.mean_cm / 100
    options = {name: getattr(scenario, name) for name in ("links", "full_m", "found_share")}
    house = simulate_house(HouseSettings(mean, spreads, **options), seed)
    prediction = forecast(house.fruit, fit_growth(house.fruit, prior), PROFILE, seed=seed)
    return compare(prediction, house)


def compare(prediction: Forecast, house: SimulatedHouse) -> tuple[float, ...]:
    """Compare a forecast with the truth, over complete cells of the true classes, days 1 on.

    Return the share of cells whose interval holds, the mean count error, that of the naive
    forecast, the fruit that become ready within three days, and the error of their number.
    """
    classes = len(PROFILE.classes)
    true_class = classes_of(house.lengths_m[:, house.of_fruit])  # of the fruit that were visible
    today_m = np.array([f.length_m for f in prediction.fruit])
    naive = classes_of(today_m + NAIVE_M_PER_DAY * np.arange(len(true_class))[:, None])
    usable = prediction.complete[:, :classes] & (prediction.days[:, None] > 0)
    counted, naive_counts = (
        np.stack([(kind == k).sum(axis=1) for k in range(classes)], axis=1)
        for kind in (true_class, naive)
    )
    low, high, expected = (
        getattr(prediction.house, name)[:, :classes] for name in ("low", "high", "expected")
    )
    pick = [prediction.classes.index(name) for name in prediction.pick]
    ready = np.isin(true_class, pick)
    picked = float((ready[1:4].any(axis=0) & ~ready[0]).sum())
    return (
        float(((low <= counted) & (counted <= high))[usable].mean()),
        float(np.abs(expected - counted)[usable].mean()),
        float(np.abs(naive_counts - counted)[usable].mean()),
        picked,
        abs(float(prediction.picks.expected[1:4, pick].sum()) - picked),
    )


def houses_table(scenarios: Sequence[Sequence[Scenario]], comment: str = "") -> ReportTable:
    """Return how the forecast does in simulated houses, a row for each group of one name."""
    rows = []
    for group in scenarios:
        outcomes = [run_house(scenario, seed) for seed, scenario in enumerate(group)]
        share, error, naive, picks, picks_error = np.mean(outcomes, axis=0)
        scenario = group[0]
        rows.append(
            (scenario.name, scenario.links, 100 * share, error, naive, 100 * picks_error / picks)
        )
    heads = ["house", "seen twice", "80 % intervals hold (%):.0", "count error:.1"]
    heads += ["by 3 cm a day:.1", "picks of 3 days, error (%):.0"]
    return ReportTable.of("Simulated houses", heads, rows, comment)


def harvest_tables(folder: Path) -> list[ReportTable]:
    """Return what forecasts the harvests of a folder, and simulated rounds at their rates.

    Raises
    ------
    DataSetError
        If there are fewer than three compartments, or one cannot be read.
    """
    houses = [read_compartment(path) for path in sorted(folder.glob("*_daily.csv"))]
    if len(houses) < 3:
        raise DataSetError(
            f"holds {len(houses)} compartments, of which each is forecast by the others",
            source=folder,
            remedy="give X_daily.csv and X_weekly.csv of at least three",
        )
    ripe = pd.concat([house.ripe for house in houses])
    groups = []
    for month in range(3):
        took = ripe[ripe.index // 30 == month]
        name = f"month {month + 1}: {took.median():.0f} days from flower to harvest"
        groups.append([Scenario(name, 500, _GROWN_CM / x, found_share=0.9) for x in took])
    comment = (
        "Rounds every second day find 90 % of the fruit. Aims: 12 %, and 76 to 86 % hold. The "
        "growth prior was chosen on other simulated houses."
    )
    return [picks_table(houses), ripening_table(houses), houses_table(groups, comment)]
