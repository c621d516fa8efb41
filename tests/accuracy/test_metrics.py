from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.accuracy.statistics import percent_errors, score


def test_by_hand() -> None:
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


def test_refusing_is_no_way_out() -> None:
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
