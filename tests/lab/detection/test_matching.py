from __future__ import annotations

import pytest

from cucumbervision_lab.detection.matching import match_boxes

FRUIT = [0.0, 0.0, 100.0, 20.0]


def shifted(by: float) -> list[float]:
    return [FRUIT[0] + by, 0.0, FRUIT[2] + by, 20.0]


@pytest.mark.parametrize(("by", "hit"), [(33.0, True), (34.0, False)])
def test_a_hit_overlaps_by_half(by: float, hit: bool) -> None:
    # Shifted by s of 100, the IoU is (100 - s) / (100 + s): 0.504 at 33 and 0.493 at 34.
    assert bool(match_boxes([shifted(by)], [FRUIT]).pairs) is hit


def test_the_best_detection_takes_the_fruit() -> None:
    found = match_boxes([shifted(10), FRUIT], [FRUIT])
    assert (found.pairs, found.false) == (((0, 0),), (1,))


def test_a_detection_takes_the_fruit_it_overlaps_most() -> None:
    found = match_boxes([shifted(4)], [shifted(20), shifted(5), shifted(-20)])
    assert (found.pairs, found.missed) == (((1, 0),), (0, 2))


def test_optional_fruit_may_be_found_once() -> None:
    found = match_boxes([FRUIT, shifted(3)], [], optional=[FRUIT])
    assert (found.pairs, found.missed, found.neutral, found.false) == ((), (), (0,), (1,))


def test_required_fruit_come_before_optional() -> None:
    # The detection overlaps the courgette more, and the cucumber enough.
    found = match_boxes([FRUIT], [shifted(20)], optional=[FRUIT])
    assert found.pairs == ((0, 0),)


@pytest.mark.parametrize(("edge", "neutral"), [(50.0, True), (49.0, False)])
def test_half_of_a_detection_in_an_ignored_region(edge: float, neutral: bool) -> None:
    found = match_boxes([FRUIT], [], ignored=[[-500.0, -500.0, edge, 500.0]])
    assert (found.neutral == (0,)) is neutral
    assert (found.false == (0,)) is not neutral


def test_fruit_in_an_ignored_region_is_still_to_be_found() -> None:
    found = match_boxes([FRUIT], [FRUIT], ignored=[[-9.0, -9.0, 300.0, 90.0]])
    assert found.pairs == ((0, 0),)
    assert match_boxes([], [FRUIT], ignored=[[-9.0, -9.0, 300.0, 90.0]]).missed == (0,)


def test_nothing_at_all() -> None:
    found = match_boxes([], [])
    assert (found.pairs, found.missed, found.false, found.neutral) == ((), (), (), ())
