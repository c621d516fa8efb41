from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

if importlib.util.find_spec("ultralytics") is None:
    pytest.skip("needs the extra 'train'", allow_module_level=True)

from cucumbervision.errors import ModelError, TrainingError
from cucumbervision_lab.train.network import average_networks, load_yolo

pytestmark = pytest.mark.train


def random_network(path: Path, kind: str = "yolo26n-seg.yaml") -> Path:
    load_yolo(kind).save(path)
    return path


def test_the_mean_lies_between_both_networks(tmp_path: Path) -> None:
    import torch

    first, second = (random_network(tmp_path / f"{name}.pt") for name in "ab")
    mean = average_networks(first, second, tmp_path / "mean.pt", 0.25)
    states = [load_yolo(path).model.float().state_dict() for path in (first, second, mean)]
    for a, b, between in zip(*(state.values() for state in states), strict=True):
        if a.is_floating_point():
            assert torch.allclose(between, 0.75 * a + 0.25 * b, atol=2e-3)


def test_what_cannot_be_averaged_is_named(tmp_path: Path) -> None:
    seg = random_network(tmp_path / "seg.pt")
    pose = random_network(tmp_path / "pose.pt", "yolo26n-pose.yaml")
    (tmp_path / "bad.pt").write_bytes(b"none")
    with pytest.raises(TrainingError, match="architecture differs"):
        average_networks(seg, pose, tmp_path / "out.pt")
    with pytest.raises(TrainingError, match="out of range"):
        average_networks(seg, seg, tmp_path / "out.pt", 1.5)
    with pytest.raises(ModelError, match=r"bad\.pt: Ultralytics cannot load"):
        average_networks(tmp_path / "bad.pt", seg, tmp_path / "out.pt")
