from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import MissingExtraError, TrainingError
from cucumbervision.perception.networks import NetworkLoader
from cucumbervision_lab.cli.screen import epoch_line
from cucumbervision_lab.cli.train import app
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.training.publish import read_card
from cucumbervision_lab.training.train import EpochReport

needs_extra = pytest.mark.skipif(
    importlib.util.find_spec("ultralytics") is None, reason="needs the extra 'train'"
)


def test_help_names_the_commands_of_training_and_not_those_of_publishing() -> None:
    text = CliRunner().invoke(app, ["--help"]).output
    for word in ("network", "recipe", "classifier", "export"):
        assert word in text
    assert "publish" not in text


def test_an_epoch_is_a_line() -> None:
    metrics = {"train/box_loss": 1.25, "train/cls_loss": 0.5, "metrics/mAP50-95(P)": 0.81}
    report = EpochReport(2500, 9000, 448, 61.4, metrics)
    assert epoch_line(report) == (
        "2500 of 9000 pictures  448 px  61 s  loss 1.750  points mAP 0.810"
    )


@needs_extra
@pytest.mark.train
@pytest.mark.parametrize("command", ["seg", "pose"])
def test_errors_come_through(command: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["network", command, "--out", str(tmp_path), "--resume"])
    assert isinstance(result.exception, TrainingError)
    assert "no training run to resume" in str(result.exception)


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
    words = [
        "classifier",
        "look",
        str(tmp_path / "set"),
        "--init",
        "yolo26n-seg.yaml",
        "--epochs",
        "1",
    ]
    words += ["--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "stem and blossom end" in result.output
    card = read_card(tmp_path / "out" / "cucumber-look.json")
    assert card.task == "look"
    held = card.metrics["ends of other scenes judged by"]
    learnt = card.metrics["crops learnt from"]
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
    words = [
        "classifier",
        "fruit",
        str(tmp_path / "set"),
        "--out",
        str(tmp_path / "out"),
        "--epochs",
        "1",
    ]
    result = CliRunner().invoke(app, [*words, "--init", "yolo26n-seg.yaml"])
    assert result.exit_code == 0, result.output
    assert "fruit told from others" in result.output
    card = read_card(tmp_path / "out" / "cucumber-fruit.json")
    assert card.task == "fruit"
    assert card.metrics["crops learnt from"] == card.metrics["crops of other scenes judged by"]
    assert card.metrics["IoU of the detector's masks, median"] > 0.9  # they are the labels
    assert (tmp_path / "out" / card.file).stat().st_size == card.size_bytes


@needs_extra
@pytest.mark.train
def test_export_names_what_is_missing(tmp_path: Path) -> None:
    words = ["export", str(tmp_path), "--out", str(tmp_path / "out"), "--name", "a"]
    result = CliRunner().invoke(app, words)
    assert isinstance(result.exception, TrainingError)
    assert "no epoch has completed yet" in str(result.exception)


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="the extra is there")
def test_missing_extra_is_named(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["network", "seg", "--out", str(tmp_path), "--resume"])
    assert isinstance(result.exception, MissingExtraError)
