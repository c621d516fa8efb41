from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from cucumbervision.measurement.intervals import Trees


def test_each_tree_asks_a_second_question_on_either_side() -> None:
    """The first feature at 1; below it the second at 2, above it the third at 3."""
    tree = Trees(10.0, ((0, 1, 2),), ((1.0, 2.0, 3.0),), ((0.1, 0.2, 0.3, 0.4),))
    expected: dict[tuple[int, ...], float] = {
        (0, 0, 0): 10.1, (0, 0, 9): 10.1, (0, 9, 0): 10.2, (0, 9, 9): 10.2,
        (9, 0, 0): 10.3, (9, 9, 0): 10.3, (9, 0, 9): 10.4, (9, 9, 9): 10.4,
    }  # fmt: skip
    for row in product((0, 9), repeat=3):
        assert tree.value(np.array(row, float)) == pytest.approx(expected[row])
    assert tree.value(np.array([1.0, 2.0, 9.0])) == pytest.approx(10.1)  # a limit belongs below


def test_values_of_trees_are_added() -> None:
    shallow = ((0, 0, 0),) * 3
    trees = Trees(1.0, shallow, ((0.5, 0.5, 0.5),) * 3, ((0.0, 0.0, 2.0, 2.0),) * 3)
    assert [trees.value(np.array([x])) for x in (0.0, 1.0)] == [1.0, 7.0]


def test_without_trees_the_value_is_the_start() -> None:
    assert Trees(-4.5).value(np.empty(0)) == -4.5
