"""Whether the forecast's intervals cover, on simulated houses, and what forecasts real harvests.

    python -m benchmarks.forecast_coverage --houses 200
    python -m benchmarks.forecast_coverage --harvests FOLDER

Growth of the simulated houses differs by house, row, fruit and day; lengths are measured with
errors. The fruit that were seen are counted, in cells that the forecast calls complete. The
harvests give growth, too, for simulated houses of which a walk every second day finds 90 %.

FOLDER holds `X_daily.csv` and `X_weekly.csv` of several compartments X under one sky, with the
columns of the Autonomous Greenhouse Challenge 2018 (Hemming et al., Sensors 19(8) 1807) as read
below. Each compartment is forecast with figures that the others gave, and its own days before.
"""

from __future__ import annotations

import argparse
import csv
import datetime
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tests.simulated_houses import HouseSettings, SimulatedHouse, simulate_house

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.forecast import Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import GrowthPrior, Spreads, fit_growth

PROFILE = load_profile("long-cucumber")
NAIVE_M_PER_DAY = 0.03
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scenario:
    """Houses of one kind; None draws the house's mean growth from the prior."""

    name: str
    links: int
    mean_cm: float | None = None
    full_m: float = float("inf")
    found: float = 1.0


SCENARIOS = (
    *(Scenario(f"3±0.8 cm/day | {links}", links) for links in (0, 5, 50)),
    *(Scenario(f"1.5 cm/day | {links}", links, 1.5) for links in (0, 50)),
    *(Scenario(f"5 cm/day | {links}", links, 5.0) for links in (0, 50)),
    *(Scenario(f"slows, full at 45 cm | {k}", k, full_m=0.45) for k in (0, 5, 50, 500)),
)


def classes_of(lengths_m: Floats) -> NDArray[np.intp]:
    """Return the index of each length's class among the profile's outcomes."""
    bins = np.searchsorted(PROFILE.edges_m, lengths_m, side="right")
    return np.array(PROFILE.outcome_of_bin, np.intp)[bins]


def run_house(scenario: Scenario, seed: int) -> tuple[float, ...]:
    """Simulate a house, forecast it and hold one against the other, as `compare` does."""
    rng = np.random.default_rng([7, seed])
    prior = GrowthPrior.of(PROFILE)
    # How far the true spreads are from the profile's.
    row, fruit, day, fruit_day = np.exp(0.35 * rng.standard_normal(4))
    p = prior.spreads
    spreads = Spreads(p.house, p.row * row, p.fruit * fruit, p.day * day, p.fruit_day * fruit_day)
    drawn = prior.mean_m + p.house * rng.standard_normal()
    mean = max(drawn, 0.005) if scenario.mean_cm is None else scenario.mean_cm / 100
    options = {name: getattr(scenario, name) for name in ("links", "full_m", "found")}
    settings = HouseSettings(mean, spreads, **options)
    house = simulate_house(settings, seed)
    prediction = forecast(house.fruit, fit_growth(house.fruit, prior), PROFILE, seed=seed)
    return compare(prediction, house)


def compare(prediction: Forecast, house: SimulatedHouse) -> tuple[float, ...]:
    """Hold a forecast against the truth, over complete cells of the true classes, days 1 on.

    Return the share of cells whose interval holds, the mean count error, that of the naive
    forecast, the fruit that become ready within three days, and the error of their number.
    """
    classes = len(PROFILE.classes)
    true_class = classes_of(house.lengths_m[:, house.of_fruit])  # of the fruit that were seen
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


def report(scenario: Scenario, outcomes: list[tuple[float, ...]]) -> str:
    """Return one line of the table."""
    share, error, naive, picks, picks_error = np.mean(outcomes, axis=0)
    errors = f"{error:.1f} / {naive:.1f} | {100 * picks_error / picks:.0f}"
    return f"| {scenario.name} | {100 * share:.0f} | {errors} |"


@dataclass(frozen=True, eq=False)
class Compartment:
    """Picks and weather by day, (D,); `ripe` has a week's last day and days from flower to pick."""

    name: str
    is_open: NDArray[np.bool_]
    fruit: Floats
    air_c: Floats
    ripe: Floats


def read_compartment(path: Path) -> Compartment:
    """Read a compartment's two files."""
    with path.open() as daily, path.with_name(f"{path.name[0]}_weekly.csv").open() as weekly:
        rows, weeks = list(csv.DictReader(daily)), list(csv.DictReader(weekly))
    dates = [datetime.date.fromisoformat(row["date"]) for row in rows]
    last = {date.isocalendar().week: float(day) for day, date in enumerate(dates)}
    fruit = "class_a_fruit_per_m2", "class_b_fruit_per_m2"
    ripe = [(last[int(row["iso_week"])], row["days_from_flower_to_harvest"]) for row in weeks]
    return Compartment(
        path.name[0],
        np.array([date.isoweekday() < 7 for date in dates]),  # nobody picked on a Sunday
        np.array([[row[name] for name in fruit] for row in rows], np.float64).sum(axis=1),
        np.array([row["air_mean_c"] or "nan" for row in rows], np.float64),
        np.array([(day, days) for day, days in ripe if days], np.float64),
    )


GROWN_CM = 30  # by which a cucumber grows from flower to harvest
TABLE = "| house | seen twice | hold, % | error / naive | picks of 3 days, error in % |"
METHODS = (
    "last week's rate",
    "own season's rate, Sundays closed",
    "with the others' seasons, worth four weeks",
)


def forecast_picks(
    house: Compartment, others: list[Compartment], day: int, days: int
) -> tuple[float, ...]:
    """Return the fruit of the next days by each of the methods."""
    first, ahead = int((house.fruit > 0).argmax()), slice(day, day + days)
    seasons = [o.fruit.sum() / o.is_open[(o.fruit > 0).argmax() :].sum() for o in others]
    picked, open_days = house.fruit[:day].sum(), house.is_open[first:day].sum()
    rates = [(picked + worth * np.mean(seasons)) / (open_days + worth) for worth in (0, 24)]
    return (
        float(house.fruit[day - 7 : day].mean() * days),
        *(float(rate * house.is_open[ahead].sum()) for rate in rates),
    )


def pick_errors(houses: list[Compartment], days: int) -> Floats:
    """Return weighted absolute errors in %, (methods, 1 + houses): of all, and of each."""
    errors = []
    for house in houses:
        others = [other for other in houses if other is not house]
        starts = range(int((house.fruit > 0).argmax()) + 7, len(house.fruit) - days + 1)
        true = np.array([house.fruit[day : day + days].sum() for day in starts])
        forecasts = np.array([forecast_picks(house, others, day, days) for day in starts])
        errors.append([*np.abs(forecasts - true[:, None]).sum(axis=0), true.sum()])
    sums = np.array([np.sum(errors, axis=0), *errors]).T
    return np.asarray(100 * sums[:-1] / sums[-1], np.float64)


def ripening(house: Compartment) -> tuple[Floats, Floats]:
    """Return what is known of each week, beside 1, and the logarithm of the days it took."""
    rows = []
    for day in house.ripe[:, 0].astype(int):
        air_c = np.nanmean(house.air_c[max(day - 20, 0) : day + 1])
        rows.append([1.0, air_c, house.fruit[max(day - 13, 0) : day + 1].mean()])
    return np.array(rows), np.log(house.ripe[:, 1])


def ripening_errors(houses: list[Compartment], columns: list[int]) -> list[float]:
    """Return the median error in days: of all, and of each compartment, fitted to the others."""
    errors = []
    for house in houses:
        features, days = zip(
            *(ripening(other) for other in houses if other is not house), strict=True
        )
        fit = np.linalg.lstsq(np.concatenate(features)[:, columns], np.concatenate(days))[0]
        left_out, true = ripening(house)
        errors.append(np.abs(np.exp(left_out[:, columns] @ fit) - np.exp(true)))
    return [float(np.median(error)) for error in (np.concatenate(errors), *errors)]


def harvests(folder: Path) -> None:
    """Print what forecasts the picks and the days from flower to harvest."""
    houses = [read_compartment(path) for path in sorted(folder.glob("?_daily.csv"))]
    head = f"all | {' | '.join(house.name for house in houses)} |"
    print(f"| picks of the next days, error in % | days | {head}")
    for days in (1, 3, 7):
        for method, errors in zip(METHODS, pick_errors(houses, days), strict=True):
            print(f"| {method} | {days} | {' | '.join(f'{e:.1f}' for e in errors)} |")
    print(f"| days from flower to harvest by, median error | {head}")
    for name, columns in {"a constant": [0], "temperature and load": [0, 1, 2]}.items():
        errors = ripening_errors(houses, columns)
        print(f"| {name} | {' | '.join(f'{e:.2f}' for e in errors)} |")
    print(TABLE)
    ripe = np.concatenate([house.ripe for house in houses])
    for month in range(3):
        days = ripe[ripe[:, 0] // 30 == month, 1]
        houses_of_month = [Scenario("", 500, GROWN_CM / x, found=0.9) for x in days]
        outcomes = [run_house(scenario, seed) for seed, scenario in enumerate(houses_of_month)]
        name = f"month {month + 1}: {np.median(days):.0f} days from flower to harvest | 500"
        print(report(Scenario(name, 500), outcomes))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--houses", type=int, default=200)
    parser.add_argument("--harvests", type=Path, help="folder of real harvests")
    options = parser.parse_args()
    if options.harvests:
        harvests(options.harvests)
        return
    print(TABLE)
    for scenario in SCENARIOS:
        outcomes = [run_house(scenario, seed) for seed in range(options.houses)]
        print(report(scenario, outcomes), flush=True)


if __name__ == "__main__":
    main()
