"""The mean of two networks: weights by hand, and what is no pair."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

if importlib.util.find_spec("ultralytics") is None:  # its import alone would ask the network
    pytest.skip("needs the extra 'train'", allow_module_level=True)

from cucumbervision.errors import ModelError, TrainingError
from cucumbervision_lab.training.checkpoint import average_networks, import_ultralytics
from cucumbervision_lab.training.export import load_yolo

pytestmark = pytest.mark.train


def write(folder: Path, name: str, kind: str = "seg", seed: int = 1) -> Path:
    """Write a checkpoint of random weights, with a place in a plan."""
    import_ultralytics()
    import torch
    from ultralytics.nn.tasks import PoseModel, SegmentationModel

    torch.manual_seed(seed)
    made = {"seg": SegmentationModel, "pose": PoseModel}[kind]
    network = made(f"yolo26n-{kind}.yaml", nc=1, verbose=False)
    path = folder / name
    torch.save({"model": network.half(), "place": {"task": kind}}, path)
    return path


def weights(path: Path) -> dict[str, Any]:
    import torch

    kept = torch.load(path, weights_only=False)
    assert set(kept) <= {"model", "place"}
    return dict(kept["model"].float().state_dict())


def test_weights_are_averaged_by_the_share(tmp_path: Path) -> None:
    import torch

    first, second = write(tmp_path, "a.pt"), write(tmp_path, "b.pt", seed=2)
    out = average_networks(first, second, tmp_path / "mean.pt", 0.25)
    one, other, mean = (weights(path) for path in (first, second, out))
    moved = 0
    for key, value in mean.items():
        if not value.is_floating_point():
            continue
        # Half precision keeps eleven binary digits.
        torch.testing.assert_close(value, 0.75 * one[key] + 0.25 * other[key], rtol=1e-3, atol=1e-4)
        moved += not torch.equal(one[key], other[key])
    assert moved > 100
    assert "place" not in torch.load(out, weights_only=False)
    assert not (tmp_path / "mean.part").exists()


class Runs:
    """Unpickled, it makes a file."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[str, str]]:
        return open, (self.path, "w")


def test_what_is_no_pair_is_refused_by_name(tmp_path: Path) -> None:
    import torch

    first, pose = write(tmp_path, "a.pt"), write(tmp_path, "pose.pt", "pose")
    with pytest.raises(TrainingError, match=r"architecture differs from a\.pt"):
        average_networks(first, pose, tmp_path / "mean.pt")
    with pytest.raises(TrainingError, match=r"share 1\.5 is out of range"):
        average_networks(first, first, tmp_path / "mean.pt", 1.5)
    broken = tmp_path / "broken.pt"
    broken.write_bytes(b"no checkpoint")
    with pytest.raises(TrainingError, match="cannot load the weights"):
        average_networks(first, broken, tmp_path / "mean.pt")
    hostile = tmp_path / "hostile.pt"
    torch.save({"model": Runs(str(tmp_path / "ran"))}, hostile)
    with pytest.raises(TrainingError, match=r"loading it would run .*open, which is"):
        average_networks(first, hostile, tmp_path / "mean.pt")
    with pytest.raises(ModelError, match=r"hostile\.pt: loading it would run"):
        load_yolo(hostile)
    assert not (tmp_path / "ran").exists()
    assert not (tmp_path / "mean.pt").exists()
