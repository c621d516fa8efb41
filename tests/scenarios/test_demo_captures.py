from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from demo_captures import SCENES, place, write_demo

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures


def test_the_bundled_captures_are_what_the_scenes_draw(tmp_path: Path) -> None:
    for folder in write_demo(tmp_path, SCENES[:1]):
        bundled = example_captures() / folder.name
        assert sorted(p.name for p in folder.rglob("*")) == sorted(
            p.name for p in bundled.rglob("*")
        )
        for name in ("capture.json", "truth.json"):
            assert json.loads((folder / name).read_text()) == json.loads(
                (bundled / name).read_text()
            )
        for mask in (folder / "mask_visib").iterdir():
            other = cv2.imread(str(bundled / "mask_visib" / mask.name), cv2.IMREAD_UNCHANGED)
            drawn = cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)
            assert other is not None
            assert drawn is not None
            # Another machine's arithmetic may flip a pixel on the outline.
            assert np.count_nonzero(drawn != other) <= 5


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_truth_is_the_bodies_own(scene: object) -> None:
    assert scene in SCENES
    found = next(s for s in SCENES if s is scene)
    truth = json.loads((example_captures() / found.name / "truth.json").read_text())
    for pose, lengths in zip(found.fruit, truth, strict=True):
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
