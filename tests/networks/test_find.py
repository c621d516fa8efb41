"""Detections of a picture merged, with the votes of a pose network."""

from __future__ import annotations

import numpy as np

from cucumbervision.fruit.instance import Instance
from cucumbervision.networks.find import each_fruit_once


def fruit_at(x: float, confidence: float, width: float = 10.0) -> Instance:
    return Instance(np.array([x, 0.0, x + width, 40.0]), confidence)


def test_the_pose_network_has_a_say_in_what_is_a_fruit() -> None:
    detected = [fruit_at(0, 0.4), fruit_at(20, 0.4), fruit_at(40, 0.2), fruit_at(60, 0.9)]
    posed = [fruit_at(0, 0.6), fruit_at(40, 0.8), fruit_at(80, 0.9)]
    fruit = each_fruit_once(detected, posed, confidence=0.3, looks=2)
    # (2 x 0.9 + 0) / 3, (2 x 0.4 + 0.6) / 3 and (2 x 0.2 + 0.8) / 3; the second has 0.27 only, and
    # what the pose network alone sees is none.
    assert [(instance.box[0], round(instance.confidence, 3)) for instance in fruit] == [
        (60, 0.6),
        (0, 0.467),
        (40, 0.4),
    ]
    without = each_fruit_once(detected, None, confidence=0.3)
    assert [instance.confidence for instance in without] == [0.9, 0.4, 0.4]
    # A pose network that sees nothing says so.
    assert [instance.confidence for instance in each_fruit_once(detected, [])] == [0.45]


def test_a_pose_votes_for_one_detection_only() -> None:
    twice = [fruit_at(0, 0.8), fruit_at(1, 0.6, width=9)]
    fruit = each_fruit_once(twice, [fruit_at(0, 1.0)], confidence=0.31)
    assert [instance.confidence for instance in fruit] == [0.9]
