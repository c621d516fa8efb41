from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision.fruit.instance import Instance
from cucumbervision.networks.yolo import merge_sizes, parse_input_sizes


def find(left: float, confidence: float, size: int, name: str = "cucumber") -> Instance:
    box = np.array([left, 0, left + 100, 20], np.float64)
    return Instance(box, confidence, class_name=name, input_size_px=size)


def test_the_mask_is_that_of_the_first_size_that_is_half_as_sure_as_the_best() -> None:
    (both,) = merge_sizes([[find(0, 0.45, 640)], [find(0, 0.9, 896)]])
    (weak,) = merge_sizes([[find(0, 0.44, 640)], [find(0, 0.9, 896)]])
    (large,) = merge_sizes([[], [find(0, 0.9, 896)]])
    assert [one.input_size_px for one in (both, weak, large)] == [640, 896, 896]


def test_boxes_that_agree_less_and_other_classes_stay_apart() -> None:
    # 40 px apart: an IoU of 60/140.
    apart = merge_sizes([[find(0, 0.8, 640)], [find(40, 0.6, 896)]])
    assert [one.confidence for one in apart] == pytest.approx([0.4, 0.3])
    leaf = merge_sizes([[find(0, 0.8, 640)], [find(0, 0.6, 896, "leaf")]])
    assert [one.class_name for one in leaf] == ["cucumber", "leaf"]


def test_each_find_joins_the_nearest_of_another_size_and_never_one_of_its_own() -> None:
    merged = merge_sizes([[find(0, 0.9, 640), find(20, 0.8, 640)], [find(22, 0.6, 896)]])
    assert [one.confidence for one in merged] == pytest.approx([0.7, 0.45])
    assert merged[1].box.tolist() == [0, 0, 100, 20]


def test_one_size_stays_as_it_is_and_nothing_gives_nothing() -> None:
    finds = (find(0, 0.9, 640), find(5, 0.8, 640))
    assert merge_sizes([finds]) == finds
    assert merge_sizes([[], []]) == ()


@pytest.mark.parametrize("text", ["650", "0", "-32", "640,", "640;960", "1e3", "4128"])
def test_what_is_no_input_size_is_refused(text: str) -> None:
    with pytest.raises(CucumberVisionError, match="is not an input size"):
        parse_input_sizes(text)
