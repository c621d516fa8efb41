from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.arrays import Pixels
from cucumbervision.capture.frames import Capture
from cucumbervision.errors import ModelError
from cucumbervision.fruit.instance import UNKNOWN_ORDER, Instance, MaskSource
from cucumbervision.fruit.masks import box_iou, box_of_mask
from cucumbervision.methods.result import MethodName, Reason
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.methods.table import AVAILABLE
from cucumbervision.networks.find import Detectors
from cucumbervision.networks.registry import Registry, load_registry
from cucumbervision.run.finders import Finder
from cucumbervision.run.options import MeasureOptions


@pytest.fixture
def plain(row_a: Capture) -> Capture:
    """The capture without the data set's masks."""
    return replace(row_a, masks=())


def names_of(finder: Finder) -> list[str]:
    return [model["name"] for model in finder.networks.models]


def test_models_find_each_fruit_once_with_keypoints_and_sams_mask(
    row_a: Capture, own_registry: Registry
) -> None:
    options = MeasureOptions(instances="models", segmenter="mobile-sam")
    finder = Finder(options, own_registry)
    instances = finder.find(row_a).instances
    # The half that was found once more is the first fruit.
    assert len(instances) == len(row_a.masks)
    for instance, mask in zip(instances, row_a.masks, strict=True):
        assert box_iou(instance.box, box_of_mask(mask)) > 0.95
        assert instance.mask_source is MaskSource.SAM
        assert instance.detector_mask is not None
        assert instance.keypoints is not None
        assert instance.keypoints[0, 1] > instance.keypoints[4, 1]  # the blossom end hangs
    assert names_of(finder) == ["tiny-segment", "tiny-pose", "mobile-sam"]
    assert finder.networks.models[0]["sha256"] == own_registry.hashes("tiny-segment")["network"]


def test_sam_draws_only_where_the_detectors_mask_fits_no_tube(
    plain: Capture, own_registry: Registry
) -> None:
    finder = Finder(MeasureOptions(instances="models"), own_registry)
    bright = finder.find(plain).instances
    assert [instance.mask_source for instance in bright] == [MaskSource.DETECTOR] * 3
    assert names_of(finder) == ["tiny-segment", "tiny-pose"]
    dark = plain.depth_m.copy()
    left, top, right, bottom = bright[0].box.round().astype(int)
    dark[top : bottom + 1, left : right + 1] = 0
    detections = finder.find(replace(plain, depth_m=dark))
    instances = detections.instances
    drawn = [instance for instance in instances if instance.mask_source is MaskSource.SAM]
    assert [tube is None for tube in detections.tubes] == [
        instance in drawn for instance in instances
    ]
    assert len(instances) == 3
    assert [box_iou(instance.box, bright[0].box) for instance in drawn] == [1.0]
    assert names_of(finder) == ["tiny-segment", "tiny-pose", "mobile-sam"]


def test_the_tube_that_judged_a_mask_is_the_fruits_and_is_fitted_once(
    plain: Capture, own_registry: Registry
) -> None:
    detections = Finder(MeasureOptions(instances="models"), own_registry).find(plain)
    for instance, tube in zip(detections.instances, detections.tubes, strict=True):
        assert tube is not None
        refitted = measure_fruit(plain, instance).measurements[MethodName.M6]
        assert tube.length_m == refitted.length_m
        longer_tube = replace(tube, length_m=1.0)
        fruit = measure_fruit(plain, instance, tube=longer_tube)
        assert list(fruit.measurements) == list(AVAILABLE)
        assert fruit.measurements[MethodName.M6].length_m == 1.0
        assert (
            MethodName.M6
            not in measure_fruit(plain, instance, (MethodName.M3,), tube=longer_tube).measurements
        )


def test_auto_looks_where_there_are_no_masks_and_loads_nothing_before(
    row_a: Capture, plain: Capture, own_registry: Registry
) -> None:
    finder = Finder(MeasureOptions(segmenter=None), own_registry)
    instances = finder.find(row_a).instances
    assert [instance.mask_source for instance in instances] == [MaskSource.DATASET] * 3
    assert finder.networks.models == []
    assert len(finder.find(plain).instances) == 3
    assert len(finder.networks.models) == 2
    finder.find(plain)
    assert len(finder.networks.models) == 2


def test_auto_without_any_detector_still_takes_a_data_sets_masks(
    row_a: Capture, plain: Capture, bare_registry: Registry
) -> None:
    finder = Finder(MeasureOptions(), bare_registry)
    assert len(finder.find(row_a).instances) == 3
    with pytest.raises(ModelError, match="without a cucumber detector"):
        finder.find(plain)


def test_a_pose_network_of_ones_own_gives_keypoints_to_the_data_sets_masks(
    row_a: Capture, own_networks: dict[str, Path], bare_registry: Registry
) -> None:
    options = MeasureOptions(instances="dataset", pose=own_networks["pose"])
    instances = Finder(options, bare_registry).find(row_a).instances
    assert all(instance.keypoints is not None for instance in instances)
    assert all(instance.mask_source is MaskSource.DATASET for instance in instances)


def test_the_look_at_each_fruit_orders_the_points_of_a_pose_network(row_a: Capture) -> None:
    pose = load_registry().resolve("cucumber-pose")["network"]
    finder = Finder(MeasureOptions(instances="dataset", pose=pose))
    posed = [x for x in finder.find(row_a).instances if x.keypoints is not None]
    assert posed
    for instance in posed:
        assert instance.keypoints is not None
        assert instance.end_confidence not in (None, UNKNOWN_ORDER)
        # These fruit hang: the stem is above.
        assert instance.keypoints[-1, 1] < instance.keypoints[0, 1]
    assert {model["task"] for model in finder.networks.models} == {"pose", "fruit"}


def test_a_pose_network_must_be_one(own_networks: dict[str, Path], own_registry: Registry) -> None:
    options = MeasureOptions(instances="models", pose=own_networks["segment"])
    with pytest.raises(ModelError, match=r"seg\.onnx: it is a segment network .*--pose"):
        Finder(options, own_registry)


def test_m4_measures_by_perceived_keypoints(row_a: Capture, own_registry: Registry) -> None:
    options = MeasureOptions(instances="models", segmenter="none")
    for instance in Finder(options, own_registry).find(row_a).instances:
        fruit = measure_fruit(row_a, instance)
        m4, m3 = fruit.measurements[MethodName.M4], fruit.measurements[MethodName.M3]
        # From the outermost pixels' middles along a hanging fruit: M3's extent, about.
        assert m4.reason is Reason.OK
        assert m4.is_direct
        assert m4.length_m is not None
        assert m3.length_m is not None
        assert m4.length_m == pytest.approx(m3.length_m, rel=0.06)


def test_a_picture_is_turned_upright_before_the_networks_see_it(
    plain: Capture, own_registry: Registry
) -> None:
    finder = Finder(MeasureOptions(instances="models"), own_registry)
    color, depth_m = plain.color[::-1, ::-1].copy(), plain.depth_m[::-1, ::-1].copy()
    turned = replace(plain, color=color, depth_m=depth_m, gravity=(0.0, -1.0, 0.0))
    found = finder.find(turned).instances
    for before, after in zip(finder.find(plain).instances, found, strict=True):
        back = after.turned(2, plain.color.shape[:2])
        assert np.allclose([*back.box, back.confidence], [*before.box, before.confidence])
        assert np.all(back.detector_mask == before.detector_mask)


def test_a_picture_without_a_clear_fruit_is_turned_where_up_is_unknown(
    plain: Capture, own_registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    fruit = Instance(np.array([10.0, 20.0, 30.0, 80.0]), 0.3)
    color = np.zeros_like(plain.color)
    color[0, 0], shape = 255, color.shape[1::-1]  # lower left, once it is turned by a quarter

    def find(_: Detectors, color_rgb: Pixels, *__: object) -> tuple[Instance, ...]:
        return (replace(fruit, confidence=0.9) if color_rgb[-1, 0, 0] else fruit,)

    monkeypatch.setattr(Detectors, "find", find)
    finder = Finder(MeasureOptions(instances="models", segmenter="none"), own_registry)
    for gravity, confidence, turns in ((None, 0.9, -1), ((0.0, 1.0, 0.0), 0.3, 0)):
        (found,) = finder.find(replace(plain, color=color, gravity=gravity)).instances
        assert (found.confidence, *found.box) == (confidence, *fruit.turned(turns, shape).box)
