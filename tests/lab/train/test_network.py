"""Real trainings of a network with random weights on eight little pictures."""

from __future__ import annotations

import csv
import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import pytest

if importlib.util.find_spec("ultralytics") is None:
    pytest.skip("needs the extra 'train'", allow_module_level=True)

from tests.lab.train.conftest import QUICK

from cucumbervision.errors import TrainingError
from cucumbervision.networks.runtime import open_network
from cucumbervision.networks.yolo import ORDER_KEY, SIZES_KEY
from cucumbervision_lab.train.export import export_trained
from cucumbervision_lab.train.network import NETWORK, average_networks, load_yolo, open_sets, train

pytestmark = pytest.mark.train


def epochs(run: Path) -> list[int]:
    with (run / "results.csv").open() as file:
        return [int(row["epoch"]) for row in csv.DictReader(file)]


def test_a_run_holds_its_weights_and_what_it_began_with(seg_run: Path) -> None:
    assert epochs(seg_run) == [1, 2]
    assert (seg_run / NETWORK).stat().st_size < 7e6  # without its optimiser
    begun = json.loads((seg_run / "begun.json").read_text())
    assert (begun["task"], begun["init"], begun["epochs"]) == ("seg", "yolo26n-seg.yaml", 2)
    used = (seg_run / "args.yaml").read_text().splitlines()
    for line in ("batch: 4", "imgsz: 64", "lr0: 0.001", "optimizer: AdamW", "nms: false"):
        assert line in used


def test_an_interrupted_run_goes_on_at_its_next_epoch(pose_set: Path, tmp_path: Path) -> None:
    def stop(_: str) -> None:
        raise KeyboardInterrupt

    sets, lines = open_sets([pose_set.parent]), list[str]()
    with pytest.raises(KeyboardInterrupt):
        train("pose", sets, tmp_path, "yolo26n-pose.yaml", replace(QUICK, epochs=3), stop)
    assert load_yolo(tmp_path / NETWORK).ckpt["epoch"] == 0
    train("pose", [], tmp_path, "yolo26n-pose.yaml", QUICK, lines.append)
    assert [line.split("  ")[0] for line in lines] == ["epoch 2 of 3", "epoch 3 of 3"]
    assert epochs(tmp_path)[-2:] == [2, 3]
    card = export_trained(tmp_path, tmp_path / "out", "tiny-pose")
    metadata = open_network(tmp_path / "out" / card.file, "onnxruntime").metadata
    assert metadata[ORDER_KEY] == "place"


def test_what_cannot_be_trained_is_named(seg_set: Path, seg_run: Path, tmp_path: Path) -> None:
    sets, new = open_sets([seg_set.parent]), tmp_path / "new"
    with pytest.raises(TrainingError, match="contains a training for segment"):
        train("pose", [], seg_run, "yolo26n-pose.yaml", QUICK)
    with pytest.raises(TrainingError, match=r"gone\.pt: weights not found"):
        train("seg", sets, new, str(tmp_path / "gone.pt"), QUICK)
    with pytest.raises(TrainingError, match="unknown task"):
        train("detect", sets, new, "yolo26n.yaml", QUICK)


def test_card_tells_of_the_run(seg_run: Path, tmp_path: Path) -> None:
    judged = tmp_path / "judged.json"
    judged.write_text('{"command": "evaluate", "recall": 0.9}')
    card = export_trained(seg_run, tmp_path, "tiny-seg", evaluation=judged, credits=["Photos: A"])
    assert card.plan == "2 of 2 epochs at 64 px, 0.0 h"
    assert open_network(tmp_path / card.file, "onnxruntime").metadata[SIZES_KEY] == "640,896"
    assert card.began_with == "yolo26n-seg.yaml"
    assert "mAP50(M)" in card.metrics
    page = (tmp_path / "tiny-seg.md").read_text()
    for word in ("AGPL-3.0", "Photos: A", card.sha256, "--epochs 2 --size 64", '"recall": 0.9'):
        assert word in page
    assert "## Trained on" in page
    assert "| not stated | not stated | 8 | 8 | 8 |" in page
    assert str(seg_run) not in page
    assert str(tmp_path) not in page


def test_what_cannot_be_exported_is_named(seg_run: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="invalid model name"):
        export_trained(seg_run, tmp_path, "Tiny Seg")
    with pytest.raises(TrainingError, match="no epoch has completed yet"):
        export_trained(tmp_path, tmp_path, "tiny")


def test_the_mean_lies_between_two_networks_of_one_architecture(tmp_path: Path) -> None:
    import torch

    first, second, pose = (tmp_path / f"{name}.pt" for name in ("first", "second", "pose"))
    for path in (first, second, pose):
        load_yolo(f"yolo26n-{'pose' if path == pose else 'seg'}.yaml").save(path)
    mean = average_networks(first, second, tmp_path / "mean.pt", 0.25)
    states = [load_yolo(path).model.float().state_dict() for path in (first, second, mean)]
    for a, b, between in zip(*(state.values() for state in states), strict=True):
        if a.is_floating_point():
            assert torch.allclose(between, 0.75 * a + 0.25 * b, atol=2e-3)
    with pytest.raises(TrainingError, match="architecture differs"):
        average_networks(first, pose, tmp_path / "out.pt")
    with pytest.raises(TrainingError, match="out of range"):
        average_networks(first, second, tmp_path / "out.pt", 1.5)
