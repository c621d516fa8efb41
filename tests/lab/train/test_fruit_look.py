"""Training of the network that looks at each fruit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")

from cucumbervision.fruit.crops import HEIGHT_PX, WIDTH_PX, FruitCrop  # noqa: E402
from cucumbervision.networks.find import FruitLooker  # noqa: E402
from cucumbervision_lab.train.classifier import ClassifierOptions  # noqa: E402
from cucumbervision_lab.train.fruit_crops import FRUIT_CROP, SURROUND_PX, Crops  # noqa: E402
from cucumbervision_lab.train.fruit_look import (  # noqa: E402
    as_batch,
    loss,
    make_network,
    moved,
    predict_fruit,
    train_fruit,
)

pytestmark = pytest.mark.train

CHECKPOINT = Path(__file__).parents[3] / "checkpoints" / "cucumber-seg.pt"
TOP, LEFT = (SURROUND_PX[0] - HEIGHT_PX) // 2, (SURROUND_PX[1] - WIDTH_PX) // 2


def bars(count: int, seed: int = 0) -> Crops:
    """Draw level green bars under masks too wide by 6 px; every fourth is brown and no fruit."""
    rng = np.random.default_rng(seed)
    planes = rng.integers(150, 190, (count, *SURROUND_PX, 6), dtype=np.uint8)
    planes[..., 3:] = 128, 0, 0
    outlines = np.zeros((count, *SURROUND_PX), np.uint8)
    points = np.zeros((count, 5, 2), np.float32)
    for k in range(count):
        left, right = rng.integers(40, 70), rng.integers(210, 240)
        half, middle = rng.integers(10, 18), SURROUND_PX[0] // 2
        rows, columns = slice(middle - half, middle + half), slice(left, right)
        planes[k, rows, columns, :3] = (40, 130, 45) if k % 4 else (120, 80, 40)
        planes[k, middle - half - 6 : middle + half + 6, left - 6 : right + 6, 5] = 255
        outlines[k, rows, columns] = 255 if k % 4 else 0
        points[k, :, 0] = np.linspace(left - 0.5, right - 0.5, 5) - LEFT
        points[k, :, 1] = middle - 0.5 - TOP
    crops = np.zeros(count, FRUIT_CROP).view(np.recarray)
    is_fruit = np.arange(count) % 4 > 0
    crops.planes, crops.outlines, crops.has_outline = planes, outlines, True
    crops.points = np.where(is_fruit[:, None, None], points, np.nan)
    crops.visible = np.where(is_fruit[:, None], np.ones((count, 5)), np.nan)
    crops.stem, crops.is_fruit, crops.confidence = np.nan, is_fruit, 0.5
    crops.held_out = np.arange(count) % 5 == 4
    return crops


def test_keypoints_move_with_what_they_mark() -> None:
    torch.manual_seed(0)
    planes = torch.zeros(24, 7, *SURROUND_PX)
    marked = np.array([[60.0, 40.0], [100, 60], [140, 56], [170, 70], [190, 50]])
    for k, (x, y) in enumerate(marked):
        rows, columns = slice(int(y) + TOP - 2, int(y) + TOP + 3), int(x) + LEFT
        planes[:, k % 3, rows, columns - 2 : columns + 3] += (k + 1) / 5
    points = torch.from_numpy(marked).float()[None].repeat(24, 1, 1)
    visible = torch.arange(5.0)[None].repeat(24, 1)
    stem = torch.ones(24)
    sampled, placed, visible, last = moved(planes, points, visible, stem)
    assert sampled.shape == (24, 7, HEIGHT_PX, WIDTH_PX)
    turned = visible[:, 0] == 4  # mirrored left to right: the order of the points turns with it
    assert 0 < turned.sum() < 24
    assert torch.equal(last, torch.where(turned, 0.0, 1.0))
    brightest = sampled[:, :3].sum(1)
    for k in range(24):
        for x, y in placed[k].round().long().tolist():
            assert brightest[k, y, x] > 0.15


def _answer(crops: Crops) -> tuple[Any, list[Any]]:
    """Return a perfect answer to crops, and what they are judged by."""
    planes, *truth = as_batch(crops, np.arange(len(crops.planes)))
    outline = planes[:, 6, TOP : TOP + HEIGHT_PX, LEFT : LEFT + WIDTH_PX]
    known = torch.nan_to_num(truth[1])
    places = torch.cat([known, 4 * torch.ones(len(known), 5, 1)], 2)
    verdict = torch.stack([8 * truth[4] - 4, torch.zeros(len(known))], 1)
    return (16 * outline - 8, places, verdict), [outline, *truth]


def test_every_part_of_the_answer_counts() -> None:
    crops = bars(8)
    (outline, places, verdict), truth = _answer(crops)
    perfect = loss((outline, places, verdict), *truth)
    shifted = places.clone()
    shifted[..., 0] += 9
    unseen = places.clone()
    unseen[..., 2] = -4
    for worse in (
        (outline.roll(9, 2), places, verdict),
        (outline, shifted, verdict),
        (outline, unseen, verdict),
        (outline, places, -verdict),
    ):
        assert loss(worse, *truth) > perfect + 0.1


def test_training_teaches_outlines_and_the_file_says_the_same(tmp_path: Path) -> None:
    crops = bars(96)
    out = tmp_path / "cucumber-fruit.onnx"
    result = train_fruit(crops, CHECKPOINT, out, ClassifierOptions(epochs=4, batch=12))
    metrics = result.metrics
    assert metrics["crops of other scenes judged by"] == 19
    before = metrics["IoU of the detector's masks, median"]
    assert metrics["IoU of the network's outlines, median"] > before + 0.05
    assert metrics["fruit told from others, area under the curve"] > 0.9
    network = make_network("yolo26n-seg.yaml")
    network.load_state_dict(torch.load(out.with_suffix(".pt"), weights_only=True))
    outlines, points, verdicts = predict_fruit(network.eval(), crops)
    inner = crops.planes[:5, TOP : TOP + HEIGHT_PX, LEFT : LEFT + WIDTH_PX]
    square = (np.zeros(2), np.array([1.0, 0.0]), 1.0)
    looker, shown = FruitLooker(out), [FruitCrop(np.ascontiguousarray(p), *square) for p in inner]
    for k, look in enumerate(looker.look(shown)):  # weights are stored in half precision
        np.testing.assert_allclose(look.outline, outlines[k], atol=0.1)
        np.testing.assert_allclose(look.points[:, :2], points[k, :, :2], atol=0.3)
        assert look.fruit == pytest.approx(verdicts[k, 0], abs=0.05)
