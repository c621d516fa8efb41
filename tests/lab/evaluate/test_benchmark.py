"""The quick benchmark: regression guards with margin, and that a killed run resumes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.intervals import IntervalModels, shipped_interval_models
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_lab.evaluate.benchmark import (
    KEYS,
    TRUTH_OF,
    TUBE_FEATURES,
    fit_interval_models,
    interval_features,
    run_benchmark,
    run_cases,
)
from cucumbervision_lab.evaluate.benchmark_report import comparable_readings
from cucumbervision_lab.evaluate.cases import Suite, paper_cases, simulate, stress_cases
from cucumbervision_lab.evaluate.measure_case import (
    CaseOptions,
    Masks,
    Row,
    measure_case,
    readings_frame,
)


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
    cases, options = [*paper_cases(1), *stress_cases(1)], CaseOptions((Masks.EXACT,))
    file = tmp_path / "records.jsonl"
    first = run_cases(cases[:1], options, file)
    done: list[int] = []
    both = run_cases(cases, options, file, report=done.append)
    assert both[0] == first[0]
    assert [row["case"] for row in both] == [case.name for case in cases]
    assert done == [1, 1]
    (other,) = run_cases(cases[:1], CaseOptions((Masks.DISTURBED,)), file)
    assert other["masks"] == Masks.DISTURBED


def test_perceived_fruit_are_what_was_found_where_the_fruit_is() -> None:
    case, options = paper_cases(6)[5], CaseOptions((Masks.PERCEIVED,))
    mask = simulate(case, frames=1).truth.visible
    own, beside = Instance(box_of_mask(mask), mask=mask), Instance(box_of_mask(mask) + 400)

    (found,) = measure_case(case, options, lambda capture: [beside, own])
    assert found["lengths_m"]["M6"] == pytest.approx(found["centreline_m"], rel=0.03)
    assert found["mask_iou"] == 1.0

    (missed,) = measure_case(case, options, lambda capture: [beside])
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
    found = intervals_of(drawn(1500, 2), fit_interval_models(drawn(1200, 1)))
    for key in ("M1", "M6", "M6 thread", "M6 chord"):
        own = found[found["method"] == key]
        covered = own[TRUTH_OF[key]].between(own["low_m"], own["high_m"])
        assert covered.mean() == pytest.approx(0.90, abs=0.035), key
