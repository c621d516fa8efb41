from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.fruit.mask_codes import fill_polygon


def test_polygon_takes_pixels_by_their_centres() -> None:
    # The diagonal of a 4x4 square: centres below it have x < y.
    triangle = np.array([[0.0, 0.0], [4, 4], [0, 4]])
    expected = np.tri(4, k=-1, dtype=bool)
    inside = fill_polygon(triangle, 4, 4)
    assert np.array_equal(inside[expected], np.ones(6, bool))
    assert not inside[np.triu_indices(4, 1)].any()


def test_polygon_reaching_beyond_the_picture_is_cut() -> None:
    assert fill_polygon(np.array([[-5.0, -5], [50, -5], [50, 50], [-5, 50]]), 3, 4).all()


@pytest.mark.parametrize(("left", "top"), [(-3, -3), (0, 0), (2, 1), (7, 3)])
def test_a_polygons_pixels_are_the_same_anywhere_in_the_picture(left: int, top: int) -> None:
    diamond = np.array([[2.0, 0], [4, 2], [2, 4], [0, 2]])
    wide = fill_polygon(diamond + 10, 30, 40)
    inside = fill_polygon(diamond + np.array([left, top]), 6, 10)
    assert inside.tolist() == wide[10 - top : 16 - top, 10 - left : 20 - left].tolist()
