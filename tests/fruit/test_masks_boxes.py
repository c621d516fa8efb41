from __future__ import annotations

import numpy as np

from cucumbervision.fruit.masks import share_inside, suppress


def test_the_best_region_counts() -> None:
    # A quarter in the first, half in the second: they are not added.
    regions = np.array([[0.0, 0, 1, 1], [2.0, 0, 4, 1]])
    assert share_inside(np.array([[0.0, 0, 4, 1]]), regions).tolist() == [0.5]


def one_class(boxes: list[list[float]], iou: float = 0.7) -> list[int]:
    """The boxes that are left, given best first."""
    scores = np.linspace(0.9, 0.5, len(boxes))
    kept = suppress(np.array(boxes, np.float32), scores, np.zeros(len(boxes), int), iou)
    return [int(k) for k in kept]


def test_suppression_threshold_is_exclusive() -> None:
    # Widths 10 and 7 within each other overlap by exactly 0.7: both stay. 7.5 goes.
    assert one_class([[0, 0, 10, 1], [0, 0, 7, 1]]) == [0, 1]
    assert one_class([[0, 0, 10, 1], [0, 0, 7.5, 1]]) == [0]


def test_a_dropped_box_drops_no_other() -> None:
    # The second goes because of the first; the third overlaps only the second enough.
    assert one_class([[0, 0, 10, 1], [1.5, 0, 11.5, 1], [3, 0, 13, 1]]) == [0, 2]


def test_classes_do_not_suppress_each_other_even_left_of_the_picture() -> None:
    # Shifted by the picture's width, the second would lie on the first.
    boxes = np.array([[90.0, 0, 100, 10], [-11, 0, -1, 10], [90, 0, 100, 10]])
    kept = suppress(boxes, np.array([0.9, 0.8, 0.7]), np.array([0, 1, 1]), 0.5)
    assert kept.tolist() == [0, 1, 2]
