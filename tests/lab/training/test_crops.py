from __future__ import annotations

from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")

from cucumbervision.capture.pictures import write_png  # noqa: E402
from cucumbervision.capture.readers import open_source  # noqa: E402
from cucumbervision.capture.source import example_captures  # noqa: E402
from cucumbervision.errors import TrainingError  # noqa: E402
from cucumbervision.perception.crops import CROP_PX, CropClassifier  # noqa: E402
from cucumbervision.perception.networks import NetworkLoader  # noqa: E402
from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture  # noqa: E402
from cucumbervision_lab.training.classifier import (  # noqa: E402
    ClassifierOptions,
    write_classifier_card,
)
from cucumbervision_lab.training.crops import (  # noqa: E402
    SURROUND_PX,
    Crops,
    collect_crops,
    train_crops,
)
from cucumbervision_lab.training.publish import read_card  # noqa: E402

pytestmark = pytest.mark.train

DETECTOR = "yolo26n-seg.yaml"  # random weights


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    """The bundled captures twice: with all detections labelled, and with none."""
    folder = tmp_path_factory.mktemp("set")
    loader = NetworkLoader()
    detector = loader.yolo(loader.verify("cucumber-seg")["network"])
    color = next(iter(open_source(example_captures()))).load().color
    boxes = [Label(one.box) for one in detector.detect(color)]
    assert boxes
    write_png(folder / "a.png", color)
    height, width = color.shape[:2]
    names = [f"scene {k}" for k in range(40)]
    val = next(name for name in names if crc32(name.encode()) % 8 == 0)
    train = next(name for name in names if crc32(name.encode()) % 8)
    pictures = (
        LabelledPicture("a.png", width, height, tuple(boxes), train, "train"),
        LabelledPicture("a.png", width, height, (), val, "train"),
        LabelledPicture("a.png", width, height, tuple(boxes), "tested", "test"),
    )
    return DataSet(folder, pictures)


def test_detections_are_cut_out_with_their_truth_and_whole_scenes_are_held_out(
    data: DataSet,
) -> None:
    crops = collect_crops([data])
    assert crops.pictures.shape[1:] == (SURROUND_PX, SURROUND_PX, 3)
    fruit = len(data.pictures[0].labels)
    assert crops.is_fruit[~crops.held_out].sum() == fruit
    assert not crops.is_fruit[crops.held_out].any()
    assert crops.held_out.sum() >= fruit
    assert ((crops.confidence > 0) & (crops.confidence < 1)).all()


def test_nothing_is_learnt_from_test_pictures(data: DataSet) -> None:
    with pytest.raises(TrainingError, match="too few scenes"):
        collect_crops([DataSet(data.folder, data.pictures[2:])])


def test_it_learns_to_tell_a_bar_from_a_disc_and_the_file_says_so_too(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    rows, columns = np.indices((SURROUND_PX, SURROUND_PX)) - SURROUND_PX // 2
    shapes = (np.hypot(rows, columns) < 30), (np.abs(rows) < 12) & (np.abs(columns) < 44)
    is_fruit = rng.random(400) < 0.5
    pictures = rng.integers(60, 120, (400, SURROUND_PX, SURROUND_PX, 3), np.uint8)
    for picture, bar in zip(pictures, is_fruit, strict=True):
        picture[shapes[int(bar)]] = (40, 180, 60)
    held_out = np.arange(400) % 4 == 0
    crops = Crops(pictures, is_fruit, np.full(400, 0.4), held_out)
    result = train_crops(crops, DETECTOR, tmp_path / "crops.onnx", ClassifierOptions(12, batch=32))
    assert (result.train_count, result.val_count) == (300, 100)
    assert result.fruit[0] == is_fruit[held_out].sum()
    assert result.fruit[1] >= result.fruit[0] - 2
    assert result.others[0] == 100 - result.fruit[0]
    assert result.others[1] <= 2
    classifier = CropClassifier(tmp_path / "crops.onnx")
    half = CROP_PX / 2.7  # the box whose crop is 96 px wide
    box = np.array([-half, -half, half, half]) + SURROUND_PX / 2 - 0.5
    odds = [classifier.log_odds(picture, [box])[0] for picture in pictures[held_out]]
    assert np.mean((np.array(odds) > 0) == is_fruit[held_out]) > 0.95
    card = write_classifier_card(result, "crops", DETECTOR, epochs=12, seed=0, credits=("Ann",))
    assert read_card(tmp_path / "crops.json") == card
    assert card.metrics["false positives with it"] == result.others[1]
