from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_greenhouse.rounds.row_views import RowStops, RowViews, row_fruit


def test_a_fruit_is_as_long_as_its_whole_views_say_together() -> None:
    # The first fruit: whole views of 0.30 and 0.31 m, equally sure, and a lower bound; the second
    # is only seen in part, by the surer of two; the third was not measured.
    stops = RowStops(np.zeros((1, 3)), np.full((1, 3), 0.03), np.zeros(1, int), np.ones((1, 2)))
    length_m = np.array([0.30, 0.31, 0.20, 0.15, 0.18, np.nan])
    length_sd = np.array([0.05, 0.05, 0.05, 0.10, 0.02, np.nan])
    cluster, partial = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 0, 1, 1, 1, 0], bool)
    at, ones, offset_m = np.zeros(6, int), np.ones(6), np.ones((6, 3))
    views = RowViews(
        at, at, offset_m, offset_m, length_m, length_sd, ones, ones, partial, ones, ones
    )
    found = row_fruit(cluster, stops, views)
    assert found.partial.tolist() == [False, True, False]
    assert found.length_m == pytest.approx([(0.30 * 0.31) ** 0.5, 0.18, np.nan], nan_ok=True)
    # Half of the variance is shared by all views: 0.05^2 (1/2 + 1/4).
    assert found.length_sd == pytest.approx([0.05 * 0.75**0.5, 0.02, np.nan], nan_ok=True)
