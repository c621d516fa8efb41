from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.perception.yolo import choose_raw, choose_rows


def raw(*anchors: tuple[float, ...]) -> np.ndarray:
    return np.array(anchors, np.float32).T


def test_rows_keep_their_order_and_exceed_the_confidence() -> None:
    rows = np.array([[0, 0, 1, 1, s, 0, 7] for s in (0.5, 0.25, 0.75)], np.float32)
    assert choose_rows(rows, 0.25)[:, 4].tolist() == [0.5, 0.75]


def test_centres_become_corners_and_extras_follow() -> None:
    out = choose_raw(raw((10, 20, 4, 8, 0.5, -1, 3)), 1, 0.3, one_to_one=True)
    assert out.tolist() == [[8, 16, 12, 24, 0.5, 0, -1, 3]]


def test_one_to_one_is_sorted_and_never_suppressed() -> None:
    out = choose_raw(raw((5, 5, 4, 4, 0.5), (5, 5, 4, 4, 0.75)), 1, 0.3, one_to_one=True)
    assert out[:, 4].tolist() == [0.75, 0.5]


def test_one_to_one_anchor_may_answer_for_two_classes() -> None:
    out = choose_raw(raw((5, 5, 4, 4, 0.5, 0.75)), 2, 0.3, one_to_one=True)
    assert out[:, 4:6].tolist() == [[0.75, 1], [0.5, 0]]


def test_one_to_one_takes_at_most_300() -> None:
    anchors = [(5.0, 5.0, 4.0, 4.0, 0.4 + i * 1e-4) for i in range(400)]
    out = choose_raw(raw(*anchors), 1, 0.3, one_to_one=True)
    assert len(out) == 300
    assert out[-1, 4] == pytest.approx(0.41)


def test_one_to_many_suppresses_within_a_class_only() -> None:
    same = choose_raw(raw((5, 5, 4, 4, 0.9, 0), (5, 5, 4, 4, 0.8, 0)), 2, 0.3, one_to_one=False)
    other = choose_raw(raw((5, 5, 4, 4, 0.9, 0), (5, 5, 4, 4, 0, 0.8)), 2, 0.3, one_to_one=False)
    assert (len(same), len(other)) == (1, 2)


def test_nothing_above_the_confidence() -> None:
    for one_to_one in (True, False):
        out = choose_raw(raw((5, 5, 4, 4, 0.3, 1, 2)), 1, 0.3, one_to_one=one_to_one)
        assert out.shape == (0, 8)
