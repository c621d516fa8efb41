from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cucumbervision.geometry.medians import valid_median


def test_an_even_count_gives_the_mean_of_the_two_middle_values() -> None:
    values = np.array([[4.0], [1.0], [2.0], [100.0]])
    valid = np.array([[True], [True], [True], [False]])
    assert valid_median(values, valid).tolist() == [2.0]
    assert valid_median(values[:3], valid[:3] & (values[:3] != 2.0)).tolist() == [2.5]


def test_no_valid_value_gives_nan() -> None:
    assert np.isnan(valid_median(np.ones((3, 2)), np.zeros((3, 2), bool))).all()


@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.booleans()), min_size=1, max_size=12))
def test_equals_numpy_on_the_valid_values(pairs: list[tuple[float, bool]]) -> None:
    values = np.array([p[0] for p in pairs])
    valid = np.array([p[1] for p in pairs])
    result = valid_median(values, valid)
    if valid.any():
        assert np.isclose(result, np.median(values[valid]))
    else:
        assert np.isnan(result)


def test_keeps_the_dtype() -> None:
    assert valid_median(np.ones((2, 2), np.float32), np.ones((2, 2), bool)).dtype == np.float32
