from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cucumbervision.tube.evidence import depth_across, outline_cracks, quick_median, valid_median


def test_an_even_count_gives_the_mean_of_the_two_middle_values() -> None:
    values = np.array([[4.0], [1.0], [2.0], [100.0]])
    valid = np.array([[True], [True], [True], [False]])
    assert valid_median(values, valid).tolist() == [2.0]
    assert valid_median(values[:3], valid[:3] & (values[:3] != 2.0)).tolist() == [2.5]


@settings(deadline=None)
@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=12))
def test_the_quick_median_is_numpys(values: list[float]) -> None:
    exact = np.array(values)
    for array in (exact, exact.astype(np.float32)):
        middle = quick_median(array)
        assert (middle, middle.dtype) == (np.median(array), array.dtype)


def test_no_valid_value_gives_nan() -> None:
    assert np.isnan(valid_median(np.ones((3, 2)), np.zeros((3, 2), bool))).all()


@settings(deadline=None)
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


def test_the_outline_runs_between_pixels_and_is_unbiased() -> None:
    rows, columns = np.mgrid[0:101, 0:101]
    disc = np.hypot(columns - 50.3, rows - 49.8) <= 30.0
    points, outward = outline_cracks(disc)
    from_centre = points - (50.3, 49.8)
    radius = np.hypot(*from_centre.T)
    # A crack is at most half a pixel's diagonal off, and on the whole not off at all.
    assert np.abs(radius - 30).max() < 0.71
    assert radius.mean() == pytest.approx(30, abs=0.05)
    assert ((from_centre * outward).sum(axis=1) > 0).all()


def test_at_the_pictures_edge_there_is_no_outline() -> None:
    mask = np.zeros((20, 20), bool)
    mask[5:10, :8] = True
    points, _ = outline_cracks(mask)
    assert points[:, 0].min() == 0  # the sides' first pixels, and nothing before them
    assert len(points) == 5 + 2 * 8


def test_depth_is_looked_for_on_the_side_asked_for() -> None:
    depth = np.full((20, 20), 0.9, np.float32)
    depth[:, :10] = 0.5
    depth[3, 11:13] = 0.0
    at, right = np.array([[9.5, 3.0], [9.5, 8.0]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(depth_across(depth, at, right), 0.9, rtol=1e-6)
    np.testing.assert_allclose(depth_across(depth, at, -right), 0.5, rtol=1e-6)


def test_without_readings_the_depth_across_is_unknown() -> None:
    nothing = depth_across(np.zeros((9, 9)), np.array([[4.5, 4.0]]), np.array([[1.0, 0.0]]))
    assert np.isnan(nothing).all()
    outside = depth_across(np.ones((9, 9)), np.array([[8.5, 4.0]]), np.array([[1.0, 0.0]]))
    assert np.isnan(outside).all()
