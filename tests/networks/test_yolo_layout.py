from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.errors import ModelError
from cucumbervision.networks.yolo import RowKind, choose_raw, choose_rows, raw_of, row_kind


@pytest.mark.parametrize(
    ("shape", "classes", "extra", "end_to_end", "expected"),
    [
        # 640x640: 6400 + 1600 + 400 cells.
        ((84, 8400), 80, 0, False, (RowKind.RAW, 80)),
        ((5, 8400), 0, 0, False, (RowKind.RAW, 1)),
        ((37, 8400), 1, 32, False, (RowKind.RAW, 1)),
        ((8400, 6), 2, 0, False, (RowKind.RAW_ROWS, 2)),
        ((8400, 6), 0, 0, False, (RowKind.RAW_ROWS, 2)),
        ((25200, 6), 1, 0, False, (RowKind.OBJECT_ROWS, 1)),
        ((25200, 6), 0, 0, False, (RowKind.OBJECT_ROWS, 1)),
        ((25200, 7), 2, 0, False, (RowKind.OBJECT_ROWS, 2)),
        ((25200, 38), 1, 32, False, (RowKind.OBJECT_ROWS, 1)),
        ((300, 6), 1, 0, True, (RowKind.FINAL, 1)),
        ((300, 6), 80, 0, False, (RowKind.FINAL, 80)),
        ((300, 38), 1, 32, True, (RowKind.FINAL, 1)),
        ((25200, 6), 2, 0, False, None),
        ((8400, 6), 1, 0, False, None),
        ((300, 5), 1, 0, False, None),
        ((300, 4), 0, 0, False, None),
    ],
)
def test_layouts_are_told_apart_by_columns_and_rows(
    shape: tuple[int, int],
    classes: int,
    extra: int,
    end_to_end: bool,
    expected: tuple[RowKind, int] | None,
) -> None:
    kind = row_kind(shape, classes=classes, extra=extra, input_px=(640, 640), end_to_end=end_to_end)
    assert kind == expected


def test_objectness_counts_for_every_class_and_extras_follow() -> None:
    rows = np.array([[5, 6, 4, 2, 0.5, 0.8, 0.2, 7]])
    raw_rows = raw_of(rows, RowKind.OBJECT_ROWS, 2)
    assert raw_rows.ravel() == pytest.approx([5, 6, 4, 2, 0.4, 0.1, 7])


@pytest.mark.parametrize(
    "row",
    [
        [0, 0, 4, 4, 0.9, 0.5],  # a class that is none
        [0, 0, 4, 4, 0.9, -1],
        [0, 0, 4, 4, 1.5, 0],  # a score beyond 1
        [8, 8, 4, 4, 0.9, 0],  # centre and size
    ],
)
def test_final_rows_of_another_kind_are_refused(row: list[float]) -> None:
    with pytest.raises(ModelError, match=r"net\.onnx: its rows are not"):
        choose_rows(np.array([row]), 0.3, source="net.onnx")


def raw(*anchors: tuple[float, ...]) -> np.ndarray:
    return np.array(anchors, np.float32).T


def test_one_to_one_anchor_may_answer_for_two_classes() -> None:
    out = choose_raw(raw((5, 5, 4, 4, 0.5, 0.75)), 2, 0.3, one_to_one=True)
    assert out[:, 4:6].tolist() == [[0.75, 1], [0.5, 0]]


def test_one_to_one_takes_at_most_300() -> None:
    anchors = [(5.0, 5.0, 4.0, 4.0, 0.4 + i * 1e-4) for i in range(400)]
    out = choose_raw(raw(*anchors), 1, 0.3, one_to_one=True)
    assert len(out) == 300
    assert out[-1, 4] == pytest.approx(0.41)
