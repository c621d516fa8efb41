from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.accuracy.statistics import binomial_interval, bootstrap_mean, compare


def test_wilcoxon_by_hand() -> None:
    # Ten pairs, the first always larger: of 2^10 sign patterns two are as extreme.
    first = np.arange(1.0, 11.0)
    result = compare(first, first - np.linspace(0.1, 0.9, 10), comparisons=4)
    assert result.p_value == pytest.approx(2 / 2**10)
    assert result.alpha == 0.0125
    assert result.significant
    assert result.median_difference == pytest.approx(0.5)


def test_equal_errors_do_not_differ() -> None:
    assert compare([1.0, 2.0], [1.0, 2.0]).p_value == 1.0


def test_few_pairs_cannot_be_significant() -> None:
    assert not compare([1.0, 2, 3], [9.0, 9, 9]).significant


def test_bootstrap_by_fruit_is_wider_than_by_capture() -> None:
    rng = np.random.default_rng(0)
    fruit = np.repeat(np.arange(7), 7)
    errors = np.repeat(rng.normal(4, 2, 7), 7) + rng.normal(0, 0.2, 49)
    by_capture = bootstrap_mean(errors)
    by_fruit = bootstrap_mean(errors, groups=fruit.tolist())
    assert np.ptp(by_fruit) > 2 * np.ptp(by_capture)
    assert by_fruit[0] < errors.mean() < by_fruit[1]


def test_bootstrap_has_the_width_of_the_standard_error() -> None:
    values = np.random.default_rng(1).normal(0, 1, 400)
    low, high = bootstrap_mean(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)
    assert bootstrap_mean(values) == (low, high)


def test_binomial_interval_by_hand() -> None:
    # No hit in n: the upper bound solves (1 - p)^n = 0.025.
    low, high = binomial_interval(0, 30)
    assert low == 0.0
    assert high == pytest.approx(1 - 0.025 ** (1 / 30))
