from __future__ import annotations

import math

import numpy as np
import pytest

from cucumbervision.accuracy.statistics import (
    ReportTable,
    cell_text,
    estimate,
    percent_errors,
    resample_weights,
    score,
    share,
)


def test_bootstrap_by_fruit_is_wider_than_by_capture() -> None:
    rng = np.random.default_rng(0)
    fruit = np.repeat(np.arange(7), 7)
    errors = np.repeat(rng.normal(4, 2, 7), 7) + rng.normal(0, 0.2, 49)
    by_capture, by_fruit = estimate(errors), estimate(errors, fruit.tolist())
    assert by_fruit.high - by_fruit.low > 2 * (by_capture.high - by_capture.low)
    assert by_fruit.low < errors.mean() < by_fruit.high


def test_bootstrap_has_the_width_of_the_standard_error() -> None:
    values = np.random.default_rng(1).normal(0, 1, 400)
    found = estimate(values, resamples=10_000)
    assert found.high - found.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)
    assert estimate(values, resamples=10_000) == found


@pytest.mark.parametrize("quantile", [0.0, 0.25, 0.5, 0.9, 1.0])
def test_quantiles_are_numpys(quantile: float) -> None:
    values = np.random.default_rng(1).lognormal(size=41)
    found = estimate(values, list(range(41)), quantile)
    assert found.value == pytest.approx(np.quantile(values, quantile))
    assert found.low <= found.value <= found.high


def test_weights_draw_as_many_groups_as_there_are() -> None:
    weights = resample_weights(7, 50)
    assert weights.shape == (50, 7)
    assert (weights.sum(axis=1) == 7).all()
    assert (weights != weights[0]).any()


def test_all_hits_leave_room_for_doubt() -> None:
    # The exact interval of 20 hits in 20 trials starts at 0.025 ** (1 / 20).
    found = share([True] * 60, [k // 3 for k in range(60)])
    assert (found.value, found.high, found.groups) == (1.0, 1.0, 20)
    assert found.low == pytest.approx(0.025 ** (1 / 20))
    none = share([False] * 20, list(range(20)))
    assert none.high == pytest.approx(1 - 0.025 ** (1 / 20))


def test_metrics_by_hand() -> None:
    # Errors +1, -1, +2 cm on 10, 20, 25 cm.
    m = score([0.11, 0.19, 0.27], [0.10, 0.20, 0.25])
    assert m.mae_cm == pytest.approx(4 / 3)
    assert m.mape_percent == pytest.approx((10 + 5 + 8) / 3)
    assert m.rmse_cm == pytest.approx(np.sqrt(2))
    mean = (10 + 20 + 25) / 3
    spread = (10 - mean) ** 2 + (20 - mean) ** 2 + (25 - mean) ** 2
    assert m.r2 == pytest.approx(1 - 6 / spread)
    assert m.median_percent == pytest.approx(8)
    assert m.worst_percent == pytest.approx(10)
    assert m.bias_percent == pytest.approx((10 - 5 + 8) / 3)
    assert m.measured == 1.0


def test_what_was_not_measured_counts_as_100_percent() -> None:
    m = score([0.20, np.nan], [0.20, 0.10])
    assert m.mape_percent == 50.0
    assert m.mae_cm == pytest.approx(5.0)
    assert m.measured == 0.5
    assert m.bias_percent == pytest.approx(0.0)
    assert percent_errors([np.nan], [0.3]).tolist() == [100.0]


def test_what_cannot_be_told_is_nan() -> None:
    m = score([0.2, 0.21], [0.2, 0.2])
    assert np.isnan(m.r2)
    assert np.isnan(m.pearson_r)
    assert np.isnan(score([np.nan], [0.2]).bias_percent)


@pytest.mark.parametrize("truth", [[], [0.0], [-0.1], [np.nan]])
def test_truth_must_be_a_length(truth: list[float]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        score([0.1] * len(truth), truth)


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (1.005, "1.00"),  # 1.005 is a little less in binary
        (-1.5, "−1.50"),
        (12, "12"),
        ("M1", "M1"),
        (True, "yes"),
        (False, "no"),
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "–"),
    ],
)
def test_a_cell_as_text(cell: float | str | None, text: str) -> None:
    assert cell_text(cell) == text


def test_json_keeps_every_digit_and_text_does_not() -> None:
    table = ReportTable.of("t", ["a:.1"], [[1 / 3]])
    assert table.as_json()["rows"][0]["a"] == 1 / 3
    assert table.text_rows() == [["0.3"]]
