"""Whether the forecast's intervals cover, and whether it beats "today + 3 cm", on simulated houses.

    python -m benchmarks.forecast_coverage --houses 200

Growth differs by house, row, fruit and day; lengths are measured with errors; fruit are missed and
invented. Only cells that the forecast calls complete are counted. Coverage of one cell is a
binomial of `--houses` trials; its 95 % interval is Clopper and Pearson's (1934). Cells of one house
are not independent, so that the interval over all cells comes from resampling houses.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tests.simulated_houses import HouseSettings, SimulatedHouse, simulate_house

from cucumbervision.crop.profiles import CropProfile, load_profile
from cucumbervision_greenhouse.forecast.forecast import Counts, DetectionRates, Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import GrowthPrior, Spreads, fit_growth

NAIVE_M_PER_DAY = 0.03
# How far the true spreads may be from the profile's: of rows, fruit, days and fruit's days.
SPREAD_LOG_SD = 0.35
CLIP = 0.01  # the least probability that the log score counts for either
DETECTION = DetectionRates(found=0.95, found_sd=0.01, false=0.02)


@dataclass(frozen=True)
class Scenario:
    """Houses of one kind; None draws the house's mean growth from the prior."""

    name: str
    links: int
    mean_cm: float | None = None
    scale_sd: float = 0.0
    full_m: float = float("inf")
    fruit_factor: float = 1.0


SCENARIOS = (
    *(Scenario(f"{links} links", links) for links in (0, 5, 20, 50, 100, 500)),
    *(Scenario(f"fruit vary twice as much, {k} links", k, fruit_factor=2) for k in (50, 500)),
    *(Scenario(f"1.5 cm/day, {links} links", links, 1.5) for links in (0, 5, 50, 500)),
    *(Scenario(f"5 cm/day, {links} links", links, 5.0) for links in (0, 5, 50, 500)),
    Scenario("50 links, depth scale 1 %", 50, scale_sd=0.01),
    *(Scenario(f"slows, full at 45 cm, {k} links", k, full_m=0.45) for k in (0, 5, 50, 500)),
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """One house: hits by cell, NaN where incomplete, and errors of forecast and naive."""

    hits: NDArray[np.float64]
    row_closed: float
    row_open: float
    pick_hits: NDArray[np.float64]
    count_error: float
    naive_count_error: float
    brier: float
    naive_brier: float
    log: float
    naive_log: float


def classes_of(lengths_m: NDArray[np.float64], profile: CropProfile) -> NDArray[np.intp]:
    """Return the index of each length's class among the profile's outcomes."""
    bins = np.searchsorted(profile.edges_m, lengths_m, side="right")
    return np.array(profile.outcome_of_bin, np.intp)[bins]


def run_house(scenario: Scenario, profile: CropProfile, seed: int) -> Outcome:
    """Simulate a house, forecast it and hold one against the other."""
    rng = np.random.default_rng([7, seed])
    prior = GrowthPrior.of(profile)
    factors = np.exp(SPREAD_LOG_SD * rng.standard_normal(5))
    factors[2] *= scenario.fruit_factor
    p = prior.spreads
    spreads = Spreads(
        p.house,
        p.row * factors[1],
        p.fruit * factors[2],
        p.day * factors[3],
        p.fruit_day * factors[4],
    )
    drawn = prior.mean_m + p.house * rng.standard_normal()
    mean = max(drawn, 0.005) if scenario.mean_cm is None else scenario.mean_cm / 100
    settings = HouseSettings(mean, spreads, links=scenario.links, scale_sd=scenario.scale_sd)
    house = simulate_house(replace(settings, full_m=scenario.full_m), seed)
    growth = fit_growth(house.links, prior)
    prediction = forecast(
        house.fruit, growth, profile, seed=seed, detection=DETECTION, scale_sd=scenario.scale_sd
    )
    return compare(prediction, house, profile)


def compare(prediction: Forecast, house: SimulatedHouse, profile: CropProfile) -> Outcome:
    """Hold a forecast against the truth, over complete cells of the true classes, days 1 on."""
    classes = len(profile.classes)
    true_class = classes_of(house.lengths_m, profile)
    counted = np.stack([(true_class == k).sum(axis=1) for k in range(classes)], axis=1)
    usable = prediction.complete[:, :classes].copy()
    usable[0] = False
    hits = np.where(usable, _inside(prediction.house, counted, classes), np.nan)
    rows = [int(name) for name in prediction.rows]
    by_row = np.stack(
        [[((true_class == k) & (house.row == r)).sum(axis=1) for k in range(classes)] for r in rows]
    ).transpose(0, 2, 1)
    lower, upper = prediction.by_row.low[..., :classes], prediction.by_row.high[..., :classes]
    closed, inside = (lower <= by_row) & (by_row <= upper), (lower < by_row) & (by_row < upper)
    pick = [prediction.classes.index(name) for name in prediction.pick]
    ready = np.isin(true_class, pick)
    first = ready & (np.cumsum(ready, axis=0) == 1)
    picked = np.stack([(first & (true_class == k)).sum(axis=1) for k in range(classes)], axis=1)
    pick_cells = usable & np.isin(np.arange(classes), pick)
    naive = classes_of(
        np.array([f.length_m for f in house.fruit])
        + NAIVE_M_PER_DAY * np.arange(len(true_class))[:, None],
        profile,
    )
    naive_counts = np.stack([(naive == k).sum(axis=1) for k in range(classes)], axis=1)
    return Outcome(
        hits,
        float(closed[:, usable].mean()),
        float(inside[:, usable].mean()),
        np.where(pick_cells, _inside(prediction.picks, picked, classes), np.nan),
        float(np.abs(prediction.house.expected[:, :classes] - counted)[usable].mean()),
        float(np.abs(naive_counts - counted)[usable].mean()),
        *_scores(prediction, house, true_class, classes_of_fruit(house, profile)),
    )


def classes_of_fruit(house: SimulatedHouse, profile: CropProfile) -> NDArray[np.intp]:
    """Return what "today + 3 cm a day" says of each found fruit, shape (D, fruit)."""
    today = {f.fruit_id: f.length_m for f in house.fruit}
    lengths = np.array([today[str(k)] for k in house.of_fruit if k >= 0])
    ahead = NAIVE_M_PER_DAY * np.arange(len(house.lengths_m))[:, None]
    return classes_of(lengths + ahead, profile)


def _inside(counts: Counts, truth: NDArray[np.intp], classes: int) -> NDArray[np.bool_]:
    return (counts.low[:, :classes] <= truth) & (truth <= counts.high[:, :classes])


def _scores(
    prediction: Forecast,
    house: SimulatedHouse,
    true_class: NDArray[np.intp],
    naive: NDArray[np.intp],
) -> tuple[float, float, float, float]:
    """Return Brier and log score of forecast and naive, for each real fruit and day from 1 on."""
    column_of = {f.fruit_id: k for k, f in enumerate(prediction.fruit)}
    real = house.of_fruit[house.of_fruit >= 0]
    columns = [column_of[str(fruit_id)] for fruit_id in real]
    forecast_share = prediction.probability[columns].transpose(1, 0, 2)[1:]
    width = forecast_share.shape[2]
    became = np.eye(width)[true_class[1:, real]]
    naive_share = np.eye(width)[naive[1:]]
    brier = [
        float(((shares - became) ** 2).sum(axis=2).mean())
        for shares in (forecast_share, naive_share)
    ]
    logs = [
        float(-np.log(np.clip((shares * became).sum(axis=2), CLIP, 1 - CLIP)).mean())
        for shares in (forecast_share, naive_share)
    ]
    return brier[0], brier[1], logs[0], logs[1]


def clopper_pearson(hits: int, trials: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a share."""
    from scipy.stats import binomtest

    interval = binomtest(hits, trials).proportion_ci(0.95, method="exact")
    return float(interval.low), float(interval.high)


def report(scenario: Scenario, outcomes: list[Outcome]) -> str:
    """Return one line of the table."""
    hits = np.array([o.hits for o in outcomes])
    shares = np.array([np.nanmean(h) for h in hits])
    rng = np.random.default_rng(0)
    resampled = rng.integers(0, len(shares), (2000, len(shares)))
    lower, upper = np.quantile(shares[resampled].mean(axis=1), [0.025, 0.975])
    cell = hits[:, 2, 0]
    cell = cell[~np.isnan(cell)]
    cell_low, cell_high = (
        clopper_pearson(int(cell.sum()), len(cell)) if len(cell) else (np.nan, np.nan)
    )
    picks = np.nanmean([o.pick_hits for o in outcomes])
    mean = {
        name: float(np.mean([getattr(o, name) for o in outcomes]))
        for name in Outcome.__dataclass_fields__
        if name not in {"hits", "pick_hits"}
    }
    return (
        f"| {scenario.name} | {100 * shares.mean():.0f} ({100 * lower:.0f} to {100 * upper:.0f}) "
        f"| {100 * cell.mean():.0f} ({100 * cell_low:.0f} to {100 * cell_high:.0f}) "
        f"| {100 * picks:.0f} | {100 * mean['row_open']:.0f} to {100 * mean['row_closed']:.0f} "
        f"| {mean['count_error']:.1f} / {mean['naive_count_error']:.1f} "
        f"| {mean['brier']:.3f} / {mean['naive_brier']:.3f} "
        f"| {mean['log']:.2f} / {mean['naive_log']:.2f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--houses", type=int, default=200)
    parser.add_argument("--only", default="", help="scenarios whose name holds this")
    options = parser.parse_args()
    profile = load_profile("long-cucumber")
    print(
        "| houses | 80 % intervals cover, % | class I, day 2 | picks | rows "
        "| count error / naive | Brier / naive | log / naive |\n|---|---|---|---|---|---|---|---|"
    )
    for scenario in SCENARIOS:
        if options.only in scenario.name:
            start = time.perf_counter()
            outcomes = [run_house(scenario, profile, seed) for seed in range(options.houses)]
            print(report(scenario, outcomes), flush=True)
            took = (time.perf_counter() - start) / options.houses
            print(f"<!-- {1000 * took:.0f} ms a house -->", flush=True)


if __name__ == "__main__":
    main()
