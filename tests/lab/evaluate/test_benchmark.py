"""The quick benchmark: regression guards with margin, and that a killed run resumes."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.intervals import (
    Band,
    IntervalModel,
    IntervalModels,
    Trees,
    shipped_interval_models,
)
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_lab.evaluate.benchmark import (
    KEYS,
    TRUTH_OF,
    TUBE_FEATURES,
    conformal_quantile,
    fit_interval_model,
    fit_interval_models,
    interval_features,
    run_benchmark,
    run_cases,
)
from cucumbervision_lab.evaluate.benchmark_report import comparable_readings
from cucumbervision_lab.evaluate.cases import Suite, paper_cases, simulate, stress_cases
from cucumbervision_lab.evaluate.measure_case import Masks, Row, measure_case, readings_frame


@pytest.fixture(scope="module")
def readings(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    out = tmp_path_factory.mktemp("benchmark")
    return run_benchmark(out, quick=True, workers=1)


def mape(readings: pd.DataFrame, method: str, masks: Masks) -> float:
    chosen = (readings["masks"] == masks) & (readings["suite"] != Suite.STRESS)
    scored = comparable_readings(readings[chosen], LengthDefinition.CENTRELINE)
    return float(scored.loc[scored["method"] == method, "error_percent"].mean())


def test_m6_stays_accurate(readings: pd.DataFrame) -> None:
    assert mape(readings, "M6", Masks.EXACT) < 1.5
    assert mape(readings, "M6", Masks.DISTURBED) < 3.0
    assert mape(readings, "M6", Masks.EXACT) < 0.5 * mape(readings, "M3", Masks.EXACT)


def test_the_papers_methods_read_what_they_are_known_to(readings: pd.DataFrame) -> None:
    assert 1 < mape(readings, "M3", Masks.EXACT) < 8
    assert 1 < mape(readings, "M5", Masks.EXACT) < 30
    assert mape(readings, "M1", Masks.EXACT) > 10


def intervals_of(readings: pd.DataFrame, book: IntervalModels) -> pd.DataFrame:
    """The readings that have an interval, with its ends."""
    rows = []
    for _, reading in readings[readings["method"].isin(KEYS)].iterrows():
        if (features := interval_features(reading)) is not None:
            ends = book.interval(reading["method"], reading["length_m"], features)
            low_m, high_m = ends or (np.nan, np.nan)
            rows.append({**reading, "low_m": low_m, "high_m": high_m})
    return pd.DataFrame(rows)


def test_every_length_of_a_method_has_an_interval(readings: pd.DataFrame) -> None:
    own = intervals_of(readings, shipped_interval_models())
    assert len(own) == (readings["method"].isin(KEYS) & readings["length_m"].notna()).sum()
    assert (own["low_m"] < own["high_m"]).all()


def test_a_killed_run_resumes_and_other_options_measure_anew(tmp_path: Path) -> None:
    cases, masks = [*paper_cases(1), *stress_cases(1)], (Masks.EXACT,)
    file = tmp_path / "records.jsonl"
    first = run_cases(cases[:1], masks, file)
    done: list[int] = []
    both = run_cases(cases, masks, file, report=done.append)
    assert both[0] == first[0]
    assert [row["case"] for row in both] == [case.name for case in cases]
    assert done == [1, 1]
    (other,) = run_cases(cases[:1], (Masks.DISTURBED,), file)
    assert other["masks"] == Masks.DISTURBED


def test_perceived_fruit_are_what_was_found_where_the_fruit_is() -> None:
    case, masks = paper_cases(6)[5], (Masks.PERCEIVED,)
    mask = simulate(case, frames=1).truth.visible
    own, beside = Instance(box_of_mask(mask), mask=mask), Instance(box_of_mask(mask) + 400)

    (found,) = measure_case(case, masks, lambda capture: [beside, own])
    assert found["lengths_m"]["M6"] == pytest.approx(found["centreline_m"], rel=0.03)
    assert found["mask_iou"] == 1.0

    (missed,) = measure_case(case, masks, lambda capture: [beside])
    assert set(missed["lengths_m"]) >= {"M1", "M6", "M6 thread", "selector best"}
    assert set(missed["lengths_m"].values()) == {None}


def drawn(count: int, seed: int) -> pd.DataFrame:
    """Fruit of 15 to 30 cm whose M6 errs by 1 %, twice as much behind leaves, and M1 by -40 %."""
    rng, rows = np.random.default_rng(seed), []
    for k in range(count):
        hidden = float(rng.uniform(0, 0.5))
        error = 0.01 * (1 + 2 * hidden) * rng.standard_normal()
        features = dict.fromkeys(TUBE_FEATURES, 0.0) | {"hidden": hidden}
        true_m = float(rng.uniform(0.15, 0.30))
        lengths = {key: true_m * float(np.exp(error)) for key in KEYS}
        lengths["M1"] = 0.6 * true_m * float(np.exp(0.1 * rng.standard_normal()))
        lengths["M6 thread"], lengths["M6 chord"] = lengths["M6"] * 1.1, lengths["M6"] * 0.97
        true = {"centreline_m": true_m, "thread_m": 1.1 * true_m, "chord_m": 0.97 * true_m}
        row: Row = {"case": f"c{k}", "suite": Suite.STRESS, "masks": Masks.EXACT, "fruit": f"f{k}"}
        row |= {"distance_m": 0.5, "tilt_deg": 0.0, "bend_radius_m": None, "hidden_share": hidden}
        row |= {"fill": 1.0, "depth_scale": float(1 + rng.normal(0, 0.01))}
        rows.append({**row, **true, "lengths_m": lengths, "m6_features": features})
    return readings_frame(rows)


def test_learnt_intervals_cover_other_fruit() -> None:
    found = intervals_of(drawn(800, 2), fit_interval_models(drawn(800, 1)))
    for key in ("M1", "M6", "M6 thread", "M6 chord"):
        own = found[found["method"] == key]
        covered = own[TRUTH_OF[key]].between(own["low_m"], own["high_m"])
        assert covered.mean() == pytest.approx(0.90, abs=0.035), key


Array: TypeAlias = NDArray[np.float64]


def test_the_conformal_rank_by_hand() -> None:
    # n = 9, level 0.9: rank ceil(9) = 9, the largest; n = 8 cannot carry it.
    assert conformal_quantile(np.arange(9), 0.9) == 8.0
    with pytest.raises(ValueError, match=r"8 fruit are too few for a level of 0\.9: need 9"):
        conformal_quantile(np.arange(8), 0.9)


def simulated(rng: np.random.Generator, count: int) -> tuple[Array, dict[str, Array]]:
    tilt, hidden = rng.uniform(0, 1, count), rng.uniform(0, 0.6, count)
    sigma = 0.004 * np.exp(1.5 * tilt + 2.0 * hidden)
    return 0.002 + sigma * rng.standard_normal(count), {"tilt": tilt, "hidden": hidden}


def test_intervals_cover_new_fruit_in_every_group() -> None:
    rng = np.random.default_rng(3)
    errors, features = simulated(rng, 3000)
    model = fit_interval_model("M6", errors, features, np.arange(3000).astype(str))
    for tilt, hidden in ((0.1, 0.1), (0.5, 0.3), (0.9, 0.5)):
        # 90 % of the errors, which are 0.002 too long, and the least spread, 0.002, beyond.
        size = 1.2816 * 0.004 * np.exp(1.5 * tilt + 2.0 * hidden)
        below, above = model.spreads({"tilt": tilt, "hidden": hidden})
        assert (below, above) == pytest.approx((size, size + 0.004), rel=0.3)
    errors, features = simulated(rng, 4000)
    truth = 0.2
    covered = np.empty(4000, bool)
    for k, error in enumerate(errors):
        values = {name: float(column[k]) for name, column in features.items()}
        low, high = model.interval(truth * np.exp(error), values)
        covered[k] = low <= truth <= high
    assert covered.mean() == pytest.approx(0.90, abs=0.015)
    for name, limit in (("tilt", 0.5), ("hidden", 0.3)):
        for group in (features[name] < limit, features[name] >= limit):
            assert covered[group].mean() == pytest.approx(0.90, abs=0.03)


def test_an_unknown_depth_scale_widens_the_interval_by_hand() -> None:
    spread = Trees(np.log(0.01))
    model = IntervalModel("M6", 0.9, (), spread, spread, {"": Band(1.5, 1.5, 100)})
    low, high = model.interval(0.3, {}, 0.01)
    half = np.hypot(1.5 * 0.01, 1.6449 * 0.01)
    assert low == pytest.approx(0.3 * np.exp(-half), rel=1e-4)
    assert high == pytest.approx(0.3 * np.exp(half), rel=1e-4)


def test_a_method_that_reads_short_gets_a_long_upper_end() -> None:
    rng = np.random.default_rng(8)
    errors = -rng.exponential(0.1, 4000)  # never long, at times far too short
    model = fit_interval_model("M1", errors, {}, np.arange(4000).astype(str))
    low, high = model.interval(0.2, {})
    assert 0.2 - low < 0.3 * (high - 0.2)
    covered = [low <= 0.2 / np.exp(e) <= high for e in -rng.exponential(0.1, 4000)]
    assert np.mean(covered) == pytest.approx(0.90, abs=0.02)


def test_readings_of_one_fruit_stay_in_one_fifth() -> None:
    # A feature that numbers the fruit, and an error that each fruit has of its own: trees know the
    # errors of the fruit they were fitted on, so that the scores of others are larger.
    rng = np.random.default_rng(5)
    fruit = np.repeat(np.arange(10), 100)
    errors = np.exp(rng.normal(-4, 1.5, 10))[fruit] * rng.choice([-1, 1], 1000)
    features = {"number": fruit.astype(float)}
    apart = fit_interval_model("M6", errors, features, fruit.astype(str))
    mixed = fit_interval_model("M6", errors, features, np.arange(1000).astype(str))
    assert apart.above == mixed.above
    assert apart.bands[""].high_quantile > 1.5 * mixed.bands[""].high_quantile
    assert apart.bands[""].count == mixed.bands[""].count == 1000
