from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.constant_network import constant_network, registry_of

from cucumbervision.errors import ModelError
from cucumbervision.fruit.crops import END_PX, PLANES, EndCrop
from cucumbervision.fruit.instance import UNKNOWN_ORDER
from cucumbervision.networks import DETECTOR_SIZES_PX
from cucumbervision.networks.find import NetworkLoader
from cucumbervision.networks.registry import file_sha256, load_registry

pytest.importorskip("onnx")

PICTURE = np.full((64, 64, 3), 90, np.uint8)


def pose_network(path: Path) -> Path:
    """Finds one fruit whatever it sees, its points ordered by place."""
    rows = np.zeros((1, 300, 21), np.float32)
    line = np.column_stack([np.linspace(10, 54, 5), np.full(5, 32), np.ones(5)])
    rows[0, 0] = [8, 24, 56, 40, 0.9, 0, *line.ravel()]
    props = {"names": {0: "cucumber"}, "end2end": True, "kpt_shape": [5, 3], "task": "pose"}
    path.write_bytes(constant_network(rows, props={**props, "keypoint_order": "place"}))
    return path


def test_the_registrys_network_that_looks_at_fruit_goes_with_points_by_place(
    tmp_path: Path,
) -> None:
    pose = pose_network(tmp_path / "pose.onnx")
    fruit = load_registry().resolve("cucumber-fruit")["network"]
    loader = NetworkLoader(registry_of(tmp_path, pose=pose, fruit=fruit), runtime="onnxruntime")
    assert loader.stem_looker() is None
    (found,) = loader.yolo("tiny-pose").detect(PICTURE)
    # Points by place are of either direction until the picture is asked.
    assert found.end_confidence == UNKNOWN_ORDER
    stem_looker = loader.stem_looker()
    assert stem_looker is not None
    assert stem_looker is loader.fruit_looker()
    assert [(m["name"], m["task"], m["sha256"]) for m in loader.models] == [
        ("tiny-pose", "pose", file_sha256(pose)),
        ("tiny-fruit", "fruit", file_sha256(fruit)),
    ]


def test_without_a_network_that_looks_at_fruit_nobody_knows_the_ends(tmp_path: Path) -> None:
    pose = pose_network(tmp_path / "own.onnx")
    loader = NetworkLoader(registry_of(tmp_path), runtime="onnxruntime")
    (found,) = loader.pose(pose).detect(PICTURE)
    assert found.end_confidence == UNKNOWN_ORDER
    assert loader.stem_looker() is None
    assert [m["name"] for m in loader.models] == ["own.onnx"]


def test_ends_are_looked_at_by_the_registrys_network_loaded_with_the_first_crops(
    tmp_path: Path,
) -> None:
    assert NetworkLoader(registry_of(tmp_path)).look_at_ends is None
    loader = NetworkLoader(runtime="onnxruntime")
    look = loader.look_at_ends
    assert look is not None
    assert loader.models == []
    crop = EndCrop(np.full((END_PX, END_PX, PLANES), 90, np.uint8), (2.0, 3.0))
    first, again = look([crop]), look([crop])
    assert first == again
    assert [model["name"] for model in loader.models] == ["cucumber-look"]


def test_a_registry_without_detector(tmp_path: Path) -> None:
    loader = NetworkLoader(registry_of(tmp_path))
    with pytest.raises(ModelError, match="without a cucumber detector"):
        loader.detectors()


def test_the_shipped_detector_runs_at_the_sizes_that_the_documentation_names() -> None:
    # An export without sizes once replaced it, and no test noticed.
    detector = NetworkLoader().yolo("cucumber-seg")
    assert detector.looks == len(DETECTOR_SIZES_PX) == 2
    page = Path(__file__).parents[2].joinpath("docs/models.md").read_text(encoding="utf-8")
    first, second = DETECTOR_SIZES_PX
    assert f"The detector runs twice, at {first} and at {second} pixels" in page
