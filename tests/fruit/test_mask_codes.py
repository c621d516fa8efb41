from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cucumbervision.fruit.mask_codes import decode_rle, fill_polygon


def test_compressed_runs_by_hand() -> None:
    # 1, 2, 3 are '1', '2', '3'; the fourth, 18, is 18 - 2 = 16 = 0b10000: its bit 4 would be read
    # as a sign, so a second character follows: 16 + 32 + 48 = '`', then '0'. Sum 24 = 6 x 4.
    assert np.array_equal(decode_rle("123`0", 4, 6), decode_rle([1, 2, 3, 18], 4, 6))
    # A falling run is negative: 1, 5, 1, 2 has 2 - 5 = -3 = 0b11101 = 29, so 29 + 48 = 'M'.
    assert np.array_equal(decode_rle("151M", 3, 3), decode_rle([1, 5, 1, 2], 3, 3))


@pytest.mark.parametrize(("counts", "fault"), [([1, 2], "fill"), ("1h", "end within"), ("é", "is")])
def test_broken_runs_are_named(counts: Any, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        decode_rle(counts, 3, 3)


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
