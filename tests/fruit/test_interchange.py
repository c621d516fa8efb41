from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cucumbervision.errors import InstancesError, MissingExtraError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.interchange import (
    from_supervision,
    from_ultralytics,
    to_supervision,
    to_ultralytics,
)


def fruit() -> list[Instance]:
    masks = np.zeros((2, 40, 80), bool)
    masks[0, 5:15, 10:50] = masks[1, 20:32, 30:70] = True
    found = [Instance.of_mask(mask, MaskSource.DETECTOR) for mask in masks]
    return [
        Instance(one.box, conf, name, mask=one.mask, mask_source=one.mask_source)
        for one, conf, name in zip(found, (0.9, 0.6), ("cucumber", "courgette"), strict=True)
    ]


def same(found: tuple[Instance, ...], given: list[Instance]) -> None:
    for one, other in zip(found, given, strict=True):
        assert one.box == pytest.approx(other.box, abs=1e-4)
        assert one.confidence == pytest.approx(other.confidence)
        assert (one.class_name, one.mask_source) == (other.class_name, other.mask_source)
        assert one.mask is not None
        assert other.mask is not None
        assert (one.mask == other.mask).all()


def test_to_ultralytics_and_back() -> None:
    pytest.importorskip("ultralytics")
    result = to_ultralytics(fruit(), np.zeros((40, 80, 3), np.uint8))
    # Its corners are those of pixels: the first mask covers columns 10 to 49.
    assert result.boxes.xyxy[0].tolist() == [10.0, 5.0, 50.0, 15.0]
    same(from_ultralytics(result), fruit())


def test_masks_of_the_networks_size_are_refused() -> None:
    boxes = SimpleNamespace(xyxy=np.zeros((0, 4)), conf=np.zeros(0), cls=np.zeros(0))
    masks = SimpleNamespace(data=np.zeros((0, 32, 32)))
    result = SimpleNamespace(
        boxes=boxes, masks=masks, keypoints=None, orig_shape=(40, 80), path="a.png", names={}
    )
    with pytest.raises(InstancesError, match="retina_masks=True"):
        from_ultralytics(result)


def test_five_keypoints_come_along_and_seventeen_do_not() -> None:
    points = np.arange(15, dtype=float).reshape(1, 5, 3)
    boxes = SimpleNamespace(xyxy=np.array([[1.0, 2, 9, 20]]), conf=np.array([0.5]), cls=np.zeros(1))

    def keypoints_of(data: Any) -> Any:
        result = SimpleNamespace(
            boxes=boxes,
            masks=None,
            keypoints=SimpleNamespace(data=data),
            names={0: "cucumber"},
            orig_shape=(40, 80),
        )
        (one,) = from_ultralytics(result)
        return one.keypoints

    assert keypoints_of(points)[1].tolist() == [2.5, 3.5, 5.0]
    assert keypoints_of(np.zeros((1, 17, 3))) is None


def test_to_supervision_and_back() -> None:
    pytest.importorskip("supervision")
    detections = to_supervision(fruit(), length_cm=[16.2, 12.0])
    assert detections.xyxy[0].tolist() == [10.0, 5.0, 50.0, 15.0]
    assert detections.data["length_cm"].tolist() == [16.2, 12.0]
    same(from_supervision(detections), fruit())


def test_a_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("supervision", "ultralytics.engine.results"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[supervision\]"):
        to_supervision(fruit())
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[train\]"):
        to_ultralytics(fruit(), np.zeros((40, 80, 3), np.uint8))
