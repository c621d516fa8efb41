from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")

from cucumbervision.capture.pictures import write_png  # noqa: E402
from cucumbervision.errors import TrainingError  # noqa: E402
from cucumbervision.perception.ends import STRIP_PX, EndClassifier  # noqa: E402
from cucumbervision.perception.registry import file_sha256  # noqa: E402
from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture  # noqa: E402
from cucumbervision_lab.training.classifier import (  # noqa: E402
    ClassifierOptions,
    write_classifier_card,
)
from cucumbervision_lab.training.ends import (  # noqa: E402
    COPIES,
    collect_strips,
    make_network,
    train_ends,
)
from cucumbervision_lab.training.publish import read_card  # noqa: E402

pytestmark = pytest.mark.train

CHECKPOINT = Path(__file__).parents[3] / "checkpoints" / "cucumber-seg.pt"


def drawn(rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Draw a green bar with a thin stalk at its last point."""
    angle = rng.uniform(0, 2 * np.pi)
    ahead = np.array([np.cos(angle), np.sin(angle)])
    points = 64 + np.linspace(-0.5, 0.5, 5)[:, None] * 70 * ahead
    picture = np.full((128, 128, 3), 110, np.uint8)
    picture += rng.integers(0, 40, picture.shape, np.uint8)
    first, last = (tuple(np.rint(p).astype(int).tolist()) for p in (points[0], points[-1]))
    tip = tuple(np.rint(points[-1] + 14 * ahead).astype(int).tolist())
    cv2.line(picture, last, tip, (60, 160, 40), 3)
    cv2.line(picture, first, last, (40, 130, 40), 14)
    return picture, points


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    folder, rng = tmp_path_factory.mktemp("set"), np.random.default_rng(4)
    (folder / "images").mkdir()
    found = []
    for number in range(80):
        color, points = drawn(rng)
        write_png(folder / f"images/{number}.png", color)
        keypoints = np.column_stack([points, np.full(5, 2.0)])
        box = np.concatenate([points.min(axis=0), points.max(axis=0)])
        label = Label(box, keypoints=keypoints)
        found.append(
            LabelledPicture(f"images/{number}.png", 128, 128, (label,), f"s{number}", "train")
        )
    return DataSet(folder, tuple(found))


def test_a_fruit_turned_round_gives_the_opposite_answer() -> None:
    network = make_network("yolo26n-seg.yaml").eval()
    fruit = torch.rand(5, 3, *STRIP_PX)
    with torch.no_grad():
        ahead, turned = network(fruit), network(torch.flip(fruit, (2, 3)))
    assert ahead.shape == (5,)
    assert torch.allclose(ahead, -turned, atol=1e-6)


def test_strips_hold_every_fruit_and_whole_scenes_are_held_out(pictures: DataSet) -> None:
    strips = collect_strips([pictures])
    assert strips.pictures.shape == (80 * COPIES, *STRIP_PX, 3)
    assert strips.held_out.sum() == 10 * COPIES
    assert strips.held_out.reshape(-1, COPIES).all(axis=1).sum() == 10
    assert (strips.seen == 2).all()


def test_it_learns_to_see_the_stalk_and_the_file_says_so_too(
    pictures: DataSet, tmp_path: Path
) -> None:
    if not CHECKPOINT.is_file():
        pytest.skip("the source archive holds no checkpoints")
    strips, options = collect_strips([pictures]), ClassifierOptions(6, batch=32)
    result = train_ends(strips, CHECKPOINT, tmp_path / "ends.onnx", options)
    assert result.accuracy["all"] > 0.9
    assert result.accuracy["2 ends in sight"] == result.accuracy["all"]
    assert (result.train_count, result.val_count) == (70, 10)
    classifier, rng = EndClassifier(tmp_path / "ends.onnx"), np.random.default_rng(99)
    right = 0
    for number in range(30):
        color, points = drawn(rng)
        given = points[::-1] if number % 2 else points
        (odds,) = classifier.log_odds(color, [given])
        assert odds is not None
        right += (odds < 0) == bool(number % 2)
    assert right >= 26
    card = write_classifier_card(result, "ends", CHECKPOINT, epochs=6, seed=0, credits=("Ann",))
    again = read_card(tmp_path / "ends.json")
    assert again == card
    assert again.sha256 == file_sha256(tmp_path / "ends.onnx")
    assert again.metrics["right, all"] == result.accuracy["all"]


def test_too_few_scenes_are_refused(pictures: DataSet) -> None:
    few = DataSet(pictures.folder, pictures.pictures[:3])
    with pytest.raises(TrainingError, match="too few scenes"):
        collect_strips([few])


def test_nothing_is_learnt_from_test_pictures(pictures: DataSet) -> None:
    from dataclasses import replace

    tests = tuple(replace(p, split="test") for p in pictures.pictures)
    with pytest.raises(TrainingError, match="too few scenes"):
        collect_strips([DataSet(pictures.folder, tests)])


def test_strips_are_drawn_with_the_stem_to_the_right(pictures: DataSet) -> None:
    strips = collect_strips([pictures])
    # The stalk has less red than the ground, and grows at the right only: a tenth of the length
    # beyond the end lies 19 columns from the strip's edge.
    red = strips.pictures[:, STRIP_PX[0] // 2 - 1 : STRIP_PX[0] // 2 + 1, :, 0].astype(int)
    left, right = red[..., 17:21].mean(axis=(1, 2)), red[..., -21:-17].mean(axis=(1, 2))
    assert np.median(left - right) > 30
