from __future__ import annotations

import json

import numpy as np
import pytest
from demo_captures import CAMERA, SCENES, DemoScene, build_scene, place

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision_lab.scenes.scene import truth_of


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_masks_and_truth_are_those_of_the_bodies(scene: DemoScene) -> None:
    truth = json.loads((example_captures() / scene.name / "truth.json").read_text())
    (capture,) = (ref.load() for ref in open_source(example_captures() / scene.name))
    drawn = truth_of(build_scene(scene), CAMERA)
    shown = [fruit.visible for fruit in drawn if fruit.visible.any()]
    for mask, visible in zip(capture.masks, shown, strict=True):
        # Another machine's arithmetic may flip a pixel on the outline.
        assert np.count_nonzero(mask != visible) <= 5
    for pose, lengths in zip(scene.fruit, truth, strict=True):
        assert lengths["centreline_m"] == pytest.approx(pose.length_m, abs=1e-4)
        assert lengths["chord_m"] <= lengths["centreline_m"] + 1e-9 <= lengths["thread_m"] + 2e-9
        assert place(pose).thread_m == pytest.approx(lengths["thread_m"], abs=1e-4)


def test_they_read_as_simulated_bursts_with_masks() -> None:
    captures = [ref.load() for ref in open_source(example_captures())]
    assert [len(c.masks) for c in captures] == [3, 3, 2]
    for capture in captures:
        assert capture.simulated
        assert capture.burst_size == 5
        assert capture.stop.row == "demo"
        # The camera's model leaves holes between leaves, few on fruit.
        assert capture.fill > 0.75
        assert all((capture.depth_m[mask] > 0).mean() > 0.95 for mask in capture.masks)
