from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("pycocotools")

from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.detection.parts import PartScore, score_parts
from cucumbervision_lab.detection.pictures import FoundFruit, Frame, Stage, TrueFruit, code_mask

Mask = NDArray[np.bool_]


def bar(left: int, right: int, top: int = 20, bottom: int = 40) -> Mask:
    mask = np.zeros((60, 200), bool)
    mask[top:bottom, left:right] = True
    return mask


def scored(true: list[Mask], seen: list[Mask], score: float = 0.9) -> PartScore:
    fruit = tuple(TrueFruit(box_of_mask(one), code_mask(one)) for one in true)
    found = tuple(FoundFruit(box_of_mask(one), score, code_mask(one)) for one in seen)
    return score_parts([Frame("a", "a", 200, 60, fruit, kept=found)], 0.3, Stage.KEPT)


LEFT, RIGHT = bar(10, 90), bar(110, 190)


@pytest.mark.parametrize(
    ("seen", "counts"),
    [
        ([LEFT | RIGHT], (1, 0, 0, 0)),
        ([LEFT, RIGHT], (0, 1, 0, 0)),
        ([RIGHT], (0, 0, 1, 0)),
        ([bar(10, 40)], (0, 0, 0, 1)),  # 30 of the part's 80 columns
        ([], (0, 0, 0, 1)),
    ],
)
def test_what_becomes_of_a_fruit_in_two_parts(
    seen: list[Mask], counts: tuple[int, int, int, int]
) -> None:
    one = scored([LEFT | RIGHT], seen)
    assert one.in_parts == 1
    assert (one.whole, one.pieces, one.part, one.missed) == counts


def test_a_find_over_two_fruit_and_a_speck_of_the_second() -> None:
    # 80 columns of each; then 80 and 10, which is an eighth of the second.
    assert scored([LEFT, RIGHT], [LEFT | RIGHT]).over_two == 1
    assert scored([LEFT, RIGHT], [LEFT | bar(110, 120)]).over_two == 0


def test_pixels_of_two_finds() -> None:
    # 20 of 100 columns are in both.
    assert scored([LEFT], [bar(0, 60), bar(40, 100)]).shared_percent == pytest.approx(20.0)
    assert scored([LEFT], [bar(0, 60), bar(40, 100)], score=0.2).finds == 0
