from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.networks.find import Detectors, NetworkLoader
from cucumbervision.networks.registry import load_registry
from cucumbervision.networks.yolo import YoloDetector
from cucumbervision_lab.data.labels import Label
from cucumbervision_lab.evaluate.pictures import (
    Frame,
    Networks,
    detect_picture,
    merge_detections,
    open_networks,
)
from cucumbervision_lab.evaluate.scenes import found_by_fruit


class Replay:
    """A detector that has looked already, at one size."""

    looks = 1
    task = "segment"

    def __init__(self, *found: Instance) -> None:
        self._found = found

    def detect(
        self, color_rgb: NDArray[np.uint8], confidence: float | None = None
    ) -> tuple[Instance, ...]:
        return self._found


@pytest.mark.parametrize("with_pose", [True, False])
def test_reported_is_what_detect_reports(with_pose: bool) -> None:
    """Two pieces of one fruit, one found twice, put together as `Detectors` does."""
    left, right = np.zeros((40, 120), bool), np.zeros((40, 120), bool)
    left[10:20, 10:50] = right[10:20, 60:110] = True
    points = np.column_stack([np.linspace(12, 108, 5), np.full(5, 14.5), np.ones(5)])
    pieces = [Instance(box_of_mask(m), 0.8, detector_mask=m) for m in (left, right, left)]
    pose = [Instance(np.array([9.5, 9.5, 109.5, 19.5]), 0.9, keypoints=points)] * with_pose
    black = np.zeros((40, 120, 3), np.uint8)
    ours = merge_detections(pieces, pose if with_pose else None, 0.3)
    loaded = [cast(YoloDetector, Replay(*found)) for found in (pieces, pose)]
    theirs = Detectors(loaded[0], loaded[1] if with_pose else None).find(black)
    # Without depth the pieces stay two.
    assert len(ours) == len(theirs) == 2
    for a, b in zip(ours, theirs, strict=True):
        assert (a.confidence, a.box.tolist()) == (b.confidence, b.box.tolist())
        assert (a.keypoints is None) == (b.keypoints is None)


def test_what_is_judged_is_what_ships() -> None:
    """The networks of the package, on the bundled captures: the same fruit, equally sure."""
    ours = NetworkLoader(full_precision=True).detectors()
    judged = open_networks(None, None, None)
    for ref in open_source(example_captures()):
        capture = ref.load()
        color, (height, width) = capture.color, capture.color.shape[:2]
        frame = Frame(capture.name, capture.name, width, height)
        focal_px = capture.intrinsics.fx_px
        found = ours.find(color, capture.depth_m, focal_px)
        kept = detect_picture(frame, color, judged, capture.depth_m, focal_px).kept
        assert len(found) > 0
        assert len(kept) == len(found)
        for one, other in zip(kept, found, strict=True):
            assert one.box == pytest.approx(other.box, abs=0.1)
            assert one.confidence == pytest.approx(other.confidence, abs=0.01)


def test_a_file_is_judged_by_itself_or_beside_the_networks_in_use() -> None:
    file = load_registry().resolve("cucumber-seg")["network"]
    pose = load_registry().resolve("cucumber-pose")["network"]
    alone = open_networks(file, "cucumber-pose", None)
    in_use = open_networks(file, "cucumber-pose", None, as_in_use=True)
    assert alone.fruit is None
    assert in_use.fruit is not None
    # Somebody's own pose network gives the keypoints.
    assert open_networks(file, pose, None, as_in_use=True).fruit is None


def test_of_low_confidence_is_ranked_and_not_reported() -> None:
    sure, unsure = np.zeros((40, 120), bool), np.zeros((40, 120), bool)
    sure[10:20, 10:50] = unsure[25:35, 60:110] = True
    replay = Replay(
        Instance(box_of_mask(sure), 0.9, detector_mask=sure),
        Instance(box_of_mask(unsure), 0.05, detector_mask=unsure),
    )
    heap = Label(np.array([80.0, 0.0, 119.0, 8.0]), ignore=True)
    labels = (heap, *(Label(box_of_mask(mask)) for mask in (unsure, sure)))
    networks = Networks(cast(YoloDetector, replay), None, None, 0.3)
    frame = Frame("a.png", "a", 120, 40, labels)
    result = detect_picture(frame, np.zeros((40, 120, 3), np.uint8), networks)
    assert [one.score for one in result.frame.segmented] == [0.9, 0.05]
    assert [one.score for one in result.frame.kept] == [0.9]
    assert list(result.seconds) == ["segment"]
    # By the index of the label that it was found for.
    assert found_by_fruit(result, 0.3) == {2: result.kept[0]}
    assert found_by_fruit(result, 0.95) == {}
