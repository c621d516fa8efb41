"""The quick form of `benchmarks/forecast_coverage.py`: few small houses, one number of links."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.simulated_houses import HouseSettings, SimulatedHouse, simulate_house

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse.forecast.forecast import DetectionRates, Forecast, forecast
from cucumbervision_greenhouse.forecast.growth import GrowthPrior, fit_growth

LONG = load_profile("long-cucumber")
PRIOR = GrowthPrior.of(LONG)
HOUSES = 16
FOUND = DetectionRates(found=0.95, found_sd=0.01, false=0.02)


@pytest.fixture(scope="module")
def pairs() -> list[tuple[SimulatedHouse, Forecast]]:
    made = []
    for seed in range(HOUSES):
        drawn = np.random.default_rng([1, seed]).standard_normal()
        mean = max(PRIOR.mean_m + PRIOR.spreads.house * drawn, 0.01)
        settings = HouseSettings(mean, PRIOR.spreads, rows=6, fruit_per_row=60, links=50)
        house = simulate_house(settings, seed)
        growth = fit_growth(house.links, PRIOR)
        made.append((house, forecast(house.fruit, growth, LONG, 4, detection=FOUND)))
    return made


def classes_of(lengths_m: NDArray[np.float64]) -> NDArray[np.intp]:
    return np.array(LONG.outcome_of_bin)[np.searchsorted(LONG.edges_m, lengths_m, side="right")]


def test_intervals_cover_and_are_no_wider_than_they_must(
    pairs: list[tuple[SimulatedHouse, Forecast]],
) -> None:
    hits = []
    for house, found in pairs:
        true = classes_of(house.lengths_m[:5])
        counts = np.stack([(true == k).sum(axis=1) for k in range(2)], axis=1)
        inside = (found.house.low[:, :2] <= counts) & (counts <= found.house.high[:, :2])
        hits.append(inside[1:][found.complete[1:, :2]].mean())
    # 16 houses of about 8 dependent cells: the mean's standard error is some 5 %.
    assert 0.65 < np.mean(hits) < 0.95


def test_naive_growth_is_beaten(pairs: list[tuple[SimulatedHouse, Forecast]]) -> None:
    errors, scores = [], []
    for house, found in pairs:
        true = classes_of(house.lengths_m[:5])
        ahead = 0.03 * np.arange(5)[:, None]
        naive = classes_of(np.array([f.length_m for f in house.fruit]) + ahead)
        counts = [np.stack([(c == k).sum(axis=1) for k in range(2)], axis=1) for c in (true, naive)]
        ours = np.abs(found.house.expected[1:, :2] - counts[0][1:]).mean()
        errors.append((ours, np.abs(counts[1] - counts[0])[1:].mean()))
        real = [k for k, f in enumerate(found.fruit) if f.fruit_id.isdecimal()]
        names = [int(found.fruit[k].fruit_id) for k in real]
        became = np.eye(4)[true[1:, names]].transpose(1, 0, 2)
        lengths = np.array([found.fruit[k].length_m for k in real])[:, None]
        told = np.eye(4)[classes_of(lengths + ahead[1:, 0])]
        brier = [
            ((p - became) ** 2).sum(axis=2).mean() for p in (found.probability[real, 1:], told)
        ]
        scores.append(brier)
    assert np.mean(errors, axis=0)[0] < 0.9 * np.mean(errors, axis=0)[1]
    assert np.mean(scores, axis=0)[0] < 0.7 * np.mean(scores, axis=0)[1]
