from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from cucumbervision.accuracy.records import Masks, Record, readings_frame
from cucumbervision.measurement.intervals import TUBE_FEATURES
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.interval_fit import (
    KEYS,
    TRUTH_OF,
    fit_interval_models,
    with_intervals,
)


def drawn(count: int, seed: int) -> pd.DataFrame:
    """Fruit of 20 cm whose M6 errs by 1 %, twice as much behind leaves, and M1 by -40 %."""
    rng = np.random.default_rng(seed)
    records = []
    for k in range(count):
        hidden = float(rng.uniform(0, 0.5))
        error = 0.01 * (1 + 2 * hidden) * rng.standard_normal()
        features = dict.fromkeys(TUBE_FEATURES, 0.0) | {"hidden": hidden}
        lengths = {key: 0.2 * float(np.exp(error)) for key in KEYS}
        lengths["M1"] = 0.12 * float(np.exp(0.1 * rng.standard_normal()))
        lengths["M6 thread"], lengths["M6 chord"] = lengths["M6"] * 1.1, lengths["M6"] * 0.97
        records.append(
            Record(
                f"c{k}",
                Suite.STRESS,
                Masks.EXACT,
                f"f{k}",
                0.2,
                0.22,
                0.194,
                0.5,
                0.0,
                None,
                hidden,
                1.0,
                depth_scale=float(1 + rng.normal(0, 0.01)),
                lengths_m=dict(lengths),
                details={"m6_features": features},
            )
        )
    return readings_frame(records)


@pytest.mark.parametrize("scale_known", [True, False])
def test_learnt_intervals_cover_other_fruit(scale_known: bool) -> None:
    book, others = fit_interval_models(drawn(1200, 1)), drawn(1500, 2)
    found = with_intervals(others, book, scale_known=scale_known)
    for key in ("M1", "M6", "M6 thread", "M6 chord"):
        own = found[found["method"] == key]
        covered = own[TRUTH_OF[key]].between(own["low_m"], own["high_m"])
        assert covered.mean() == pytest.approx(0.90, abs=0.035), key


def test_hidden_fruit_get_wider_intervals() -> None:
    book = fit_interval_models(drawn(1200, 1))
    seen = dict.fromkeys(TUBE_FEATURES, 0.0)
    narrow = book.interval("M6", 0.2, seen, scale_known=True)
    wide = book.interval("M6", 0.2, {**seen, "hidden": 0.5}, scale_known=True)
    assert narrow is not None
    assert wide is not None
    assert wide[1] - wide[0] > 1.5 * (narrow[1] - narrow[0])


def test_what_was_not_measured_has_no_interval() -> None:
    readings = drawn(1, 3)
    found = with_intervals(readings.assign(length_m=np.nan), fit_interval_models(drawn(200, 4)))
    assert found["low_m"].isna().all()
    assert len(found) == len(KEYS)


def test_too_few_fruit_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot carry a level"):
        fit_interval_models(drawn(20, 5))
