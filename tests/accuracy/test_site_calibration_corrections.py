from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cucumbervision.accuracy.calibration_file import Form, corrected
from cucumbervision.accuracy.site_calibration import conformal_half_width, fit_correction

TRUTH = np.linspace(0.10, 0.34, 12)
NAMES = [f"f{k}" for k in range(12)]


@settings(deadline=None, max_examples=25)
@given(scale=st.floats(0.7, 1.4), count=st.integers(6, 12))
def test_a_pure_scale_is_recovered_exactly(scale: float, count: int) -> None:
    fit = fit_correction(TRUTH[:count] / scale, TRUTH[:count], NAMES[:count])
    if abs(scale - 1) < 1e-4:  # less than a hundredth of a point to gain
        assert fit.form is Form.NONE
    else:
        assert fit.form is Form.SCALE
        assert fit.scale == pytest.approx(scale, rel=1e-9)
        assert fit.offset_m == 0
        assert fit.error_after_percent < 1e-6
        assert fit.error_before_percent == pytest.approx(100 * abs(1 / scale - 1))


@settings(deadline=None, max_examples=25)
@given(scale=st.floats(0.8, 1.25), offset=st.floats(0.004, 0.03), sign=st.sampled_from([-1, 1]))
def test_scale_and_offset_are_recovered_exactly(scale: float, offset: float, sign: int) -> None:
    fit = fit_correction((TRUTH - sign * offset) / scale, TRUTH, NAMES)
    assert fit.form is Form.SCALE_OFFSET
    assert fit.scale == pytest.approx(scale, rel=1e-6)
    assert fit.offset_m == pytest.approx(sign * offset, rel=1e-6)


@pytest.mark.parametrize(("count", "form"), [(5, Form.NONE), (6, Form.SCALE), (9, Form.SCALE)])
def test_too_few_fruit_are_refused_with_the_least_number(count: int, form: Form) -> None:
    raw = TRUTH[:count] / 1.1 - 0.01
    fit = fit_correction(raw, TRUTH[:count], NAMES[:count])
    assert fit.form is form
    if form is Form.NONE:
        assert "scale needs 6 fruit, there are 5" in fit.reason
        assert (fit.scale, fit.offset_m) == (1.0, 0.0)
    assert f"scale+offset needs 10 fruit, there are {count}" in fit.reason


def test_noise_without_bias_is_seldom_taken_for_a_bias() -> None:
    rng = np.random.default_rng(1)
    taken = 0
    for _ in range(120):
        raw = TRUTH * (1 + rng.normal(0, 0.08, 12))
        taken += fit_correction(raw, TRUTH, NAMES).form is not Form.NONE
    # A gain above one standard error by chance: under 16 %, and leaving out costs besides.
    assert taken / 120 < 0.16


def test_one_gross_error_does_not_drag_the_scale() -> None:
    raw = TRUTH / 1.05
    raw[3] *= 0.4  # the paper's M5 on a fruit that points at the camera
    fit = fit_correction(raw, TRUTH, NAMES)
    assert fit.scale == pytest.approx(1.05, rel=2e-3)


def test_a_fruit_captured_often_counts_once() -> None:
    raw = np.concatenate([TRUTH[:11], np.full(20, TRUTH[11] / 2)])
    truth = np.concatenate([TRUTH[:11], np.full(20, TRUTH[11])])
    fit = fit_correction(raw, truth, NAMES[:11] + [NAMES[11]] * 20)
    # Eleven fruit without error and one with 50 %: 50/12 % on average, weighted by fruit.
    assert fit.error_before_percent == pytest.approx(50 / 12)


def test_held_out_error_by_hand() -> None:
    # Readings of 1/1.1 but for one fruit that reads true. Left out, it is corrected by 1.1: 10 %
    # off; each other is corrected by nearly 1.1, since Huber's weight of the odd one vanishes.
    raw = TRUTH[:9] / 1.1
    raw[0] = TRUTH[0]
    fit = fit_correction(raw, TRUTH[:9], NAMES[:9])
    assert fit.form is Form.SCALE
    assert fit.error_after_percent == pytest.approx(10 / 9, rel=1e-3)
    assert fit.error_before_percent == pytest.approx(100 * 8 / 9 * (1 - 1 / 1.1))
    # Nine fruit at 90 %: the interval needs all nine, so the odd one sets it: 1/1.1 - 1.
    assert fit.interval.half_width == pytest.approx(1 - 1 / 1.1, rel=1e-3)


def test_nothing_or_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="positive"):
        fit_correction([], [], [])
    with pytest.raises(ValueError, match="positive"):
        fit_correction([0.2, -0.1], [0.2, 0.2], ["a", "b"])


def test_conformal_quantile_by_hand() -> None:
    # 19 fruit at 90 %: the 18th smallest of 19, ceil(0.9 x 20) = 18.
    scores = np.arange(1.0, 20.0)
    assert conformal_half_width(scores, [f"{k}" for k in range(19)]) == 18
    # Nine fruit, one with two readings of weight 1/2 each: all of the weight is needed.
    assert conformal_half_width([*range(1, 10), 12.0], [*"abcdefghi", "a"]) == 12
    assert conformal_half_width(np.ones(200), ["a", "b"] * 100) is None
    assert conformal_half_width([*range(8), np.inf], list("abcdefghi")) is None


def test_the_interval_holds_on_new_fruit() -> None:
    rng = np.random.default_rng(7)
    hits = 0
    for _ in range(200):
        truth = rng.uniform(0.1, 0.35, 16)
        raw = truth / 1.06 * (1 + rng.standard_t(4, 16) * 0.02)
        fit = fit_correction(raw[:15], truth[:15], [str(k) for k in range(15)])
        assert fit.interval.half_width is not None
        length = corrected(raw[15], fit.scale, fit.offset_m)
        hits += abs(truth[15] / length - 1) <= fit.interval.half_width
    # ceil(0.9 x 16) = 15 of 15, so 15/16 = 93.75 % is what the theory promises; binomial sd 1.7 %.
    assert 0.90 <= hits / 200 <= 0.985


def test_readings_that_fall_with_the_length_are_not_corrected() -> None:
    fit = fit_correction(0.5 - TRUTH, TRUTH, NAMES)
    assert (fit.form, fit.scale, fit.offset_m) == (Form.NONE, 1.0, 0.0)
    assert fit.reason.endswith("it reads shorter, the longer the fruit is: no correction")
