from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from tests.lab.train.conftest import write_set
from typer.testing import CliRunner

from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.networks.find import NetworkLoader
from cucumbervision_lab.cli.train import app
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture

ONE_EPOCH = ("--init", "yolo26n-seg.yaml", "--epochs", "1")
needs_extra = pytest.mark.skipif(
    importlib.util.find_spec("ultralytics") is None, reason="needs the extra 'train'"
)


@needs_extra
@pytest.mark.train
def test_a_detector_is_trained_by_the_command(tmp_path: Path) -> None:
    data = write_set(tmp_path / "set", "segment").parent
    words = ["network", "seg", str(data), "--out", str(tmp_path / "run"), "--epochs", "1"]
    words += ["--size", "64", "--device", "cpu", "--init"]
    result = CliRunner().invoke(app, [*words, "yolo26n-seg.yaml"])
    assert result.exit_code == 0, result.output
    assert "epoch 1 of 1" in result.output
    assert (tmp_path / "run" / "weights" / "last.pt").is_file()


@needs_extra
@pytest.mark.train
def test_the_look_at_ends_is_learnt_from_pasted_fruit_and_shown(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    rng, pictures = np.random.default_rng(1), []
    (tmp_path / "set" / "images").mkdir(parents=True)
    for number in range(16):
        color = rng.integers(0, 255, (96, 160, 3), np.uint8)
        write_png(tmp_path / "set" / "images" / f"{number}.png", color)
        whole = np.zeros((96, 160), bool)
        whole[40:56, 20:130] = True
        seen = whole.copy()
        seen[:, 90:] &= number % 2 == 0  # a third of every other fruit is hidden
        label = Label.of_mask(seen, amodal=whole)
        name = f"images/{number}.png"
        pictures.append(LabelledPicture(name, 160, 96, (label,), f"s{number}", "train"))
    write_coco(DataSet(tmp_path / "set", tuple(pictures)), tmp_path / "set")
    words = ["look", str(tmp_path / "set"), "--out", str(tmp_path / "out"), *ONE_EPOCH]
    result = CliRunner().invoke(app, ["classifier", *words])
    assert result.exit_code == 0, result.output
    assert "stem and blossom end" in result.output
    card = json.loads((tmp_path / "out" / "cucumber-look.json").read_text())
    assert card["task"] == "look"
    held = card["metrics"]["ends of other scenes judged by"]
    learnt = card["metrics"]["crops learnt from"]
    assert 0 < held < 32
    assert learnt == 2 * (32 - held)  # each end of training once more, moved
    # Pasted fruit have no depth: none is measured, and no interval learnt.
    assert not (tmp_path / "out" / "interval_models.json").exists()


@needs_extra
@pytest.mark.train
def test_the_look_at_fruit_is_learnt_from_labelled_sets_and_shown(tmp_path: Path) -> None:
    color = next(iter(open_source(example_captures()))).load().color
    height, width = color.shape[:2]
    loader = NetworkLoader()
    found = loader.yolo(loader.verify("cucumber-seg")["network"]).detect(color)
    labels = tuple(Label.of_mask(x.detector_mask) for x in found if x.detector_mask is not None)
    (tmp_path / "set" / "images").mkdir(parents=True)
    write_png(tmp_path / "set" / "images" / "a.png", color)
    pictures = tuple(
        LabelledPicture("images/a.png", width, height, shown, f"{split} {len(shown)}", split)
        for split in ("train", "val")
        for shown in (labels, ())
    )
    write_coco(DataSet(tmp_path / "set", pictures), tmp_path / "set")
    words = ["fruit", str(tmp_path / "set"), "--out", str(tmp_path / "out"), *ONE_EPOCH]
    result = CliRunner().invoke(app, ["classifier", *words])
    assert result.exit_code == 0, result.output
    assert "fruit told from others" in result.output
    card = json.loads((tmp_path / "out" / "cucumber-fruit.json").read_text())
    assert card["task"] == "fruit"
    metrics = card["metrics"]
    assert metrics["crops learnt from"] == metrics["crops of other scenes judged by"]
    assert metrics["IoU of the detector's masks, median"] > 0.9  # they are the labels
    assert (tmp_path / "out" / card["file"]).stat().st_size == card["size_bytes"]
