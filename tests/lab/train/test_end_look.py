from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")

from cucumbervision.fruit.crops import END_PX, PLANES, QUANTILES, EndCrop  # noqa: E402
from cucumbervision.networks.find import ERROR_SCALE, EndLooker  # noqa: E402
from cucumbervision_lab.train.classifier import ClassifierOptions, begun_network  # noqa: E402
from cucumbervision_lab.train.end_crops import END_CROP, states_of  # noqa: E402
from cucumbervision_lab.train.end_look import (  # noqa: E402
    _loss,
    augmented,
    fit_look,
    judge_look,
    make_network,
    train_look,
)
from cucumbervision_lab.train.fruit_crops import Crops, crops_of  # noqa: E402

pytestmark = pytest.mark.train

CHECKPOINT = Path(__file__).parents[3] / "checkpoints" / "cucumber-seg.pt"


def crops(count: int = 240, seed: int = 0) -> Crops:
    """Draw bars from the left that end in the middle, every other one under a yellow leaf."""
    rng = np.random.default_rng(seed)
    planes = rng.integers(80, 120, (count, END_PX, END_PX, PLANES), dtype=np.uint8)
    planes[..., 3:] = 128, 255, 0
    middle = slice(END_PX // 2 - 8, END_PX // 2 + 8)
    planes[:, middle, : END_PX // 2, :3] = 40, 140, 40
    planes[:, middle, : END_PX // 2, 5] = 255
    covered = np.arange(count) % 2 == 1
    planes[covered, :, END_PX // 2 :, :3] = 220, 210, 40
    missing = np.where(covered, 0.3, 0.0) + rng.normal(0, 0.01, count)
    numbers = np.arange(count)
    held_out = numbers % 6 > 3
    columns = planes, [(2, 3)] * count, missing, covered, numbers // 2, [False] * count, held_out
    return crops_of(list(zip(*columns, strict=True)), END_CROP)


def test_it_learns_to_see_the_leaf_and_the_file_says_the_same(tmp_path: Path) -> None:
    if not CHECKPOINT.is_file():
        pytest.skip("the source archive holds no checkpoints")
    drawn = crops()
    result = train_look(drawn, CHECKPOINT, tmp_path / "look.onnx", ClassifierOptions(4, batch=16))
    metrics = result.metrics
    assert metrics["crops learnt from"] == 160
    assert metrics["ends of other scenes judged by"] == 80
    assert metrics["covered ends told from others, area under the curve"] > 0.95
    assert metrics["stem and blossom ends told right"] > 0.9
    looker = EndLooker(result.network)
    held = drawn[np.flatnonzero(drawn.held_out)[:8]].view(np.recarray)
    looks = looker.look(
        [EndCrop(one.planes, (float(one.shapes[0]), float(one.shapes[1]))) for one in held]
    )
    found = np.array([look.covered for look in looks])
    assert (found[states_of(held) == 1].min()) > found[states_of(held) == 0].max()
    again = begun_network(result.network.with_suffix(".pt"), make_network)
    assert judge_look(again.eval(), drawn, result.network).metrics == metrics


def test_an_interrupted_training_goes_on_where_it_was(tmp_path: Path) -> None:
    drawn, keep = crops(48), tmp_path / "training.pt"
    options = ClassifierOptions(3, batch=16, keep=keep)

    class InterruptError(Exception):
        pass

    def stop(epoch: int, _: float) -> None:
        if epoch == 2:
            raise InterruptError

    with pytest.raises(InterruptError):
        fit_look(drawn, "yolo26n-seg.yaml", replace(options, progress=stop))
    epochs: list[int] = []
    fit_look(
        drawn, "yolo26n-seg.yaml", replace(options, progress=lambda epoch, _: epochs.append(epoch))
    )
    assert epochs == [3]
    # What another training left in the folder is not taken for this one's.
    other = replace(options, seed=7, progress=lambda epoch, _: epochs.append(epoch))
    fit_look(drawn, "yolo26n-seg.yaml", other)
    assert epochs == [3, 1, 2, 3]


def test_held_out_scenes_and_moved_copies_are_not_judged_by_what_was_learnt() -> None:
    drawn = crops(48)
    moved: Any = drawn.copy()
    moved.moved = drawn.held_out & (drawn.fruit % 2 == 0)
    judged = judge_look(make_network("yolo26n-seg.yaml").eval(), moved, Path("look.onnx"))
    held = int((moved.held_out & ~moved.moved).sum())
    assert judged.metrics["ends of other scenes judged by"] == held
    assert judged.metrics["crops learnt from"] == int((~moved.held_out).sum())


def test_the_loss_is_least_where_quantiles_are_true_and_knows_no_label_that_is_none() -> None:
    state, missing = torch.zeros(2001), torch.linspace(-0.05, 0.05, 2001)
    target = torch.stack([state, missing, torch.full((2001,), torch.nan)], 1)

    def loss(levels: list[float], labels: object = target) -> float:
        row = [9.0, 0, 0, *np.arcsinh(np.array(levels) / ERROR_SCALE), 0]
        return float(_loss(torch.tensor(row).float().expand(2001, 9), labels))

    best = (np.array(QUANTILES) - 0.5) * 0.1
    for change in (-0.01, 0.01):
        for k in range(len(QUANTILES)):
            other = best.copy()
            other[k] += change
            assert loss(list(other)) > loss(list(best))
    nothing = torch.full((2001, 3), torch.nan)
    nothing[:, 0] = 0
    assert loss(list(best), nothing) == pytest.approx(loss([0.5] * 5, nothing))


def test_augmenting_keeps_planes_in_their_range_and_the_end_in_its_place() -> None:
    torch.manual_seed(0)
    planes = torch.from_numpy(crops(16).planes.transpose(0, 3, 1, 2)).float() / 255
    seen = augmented(planes)
    assert seen.shape == planes.shape
    assert float(seen.min()) >= 0
    assert float(seen.max()) <= 1
    half = END_PX // 2
    assert bool((seen[:, 5, half, : half - 2] > 0.9).all())
    assert bool((seen[:, 5, half, half + 2 :] < 0.1).all())
    assert set(seen[:, 4].unique().tolist()) == {0.0, 1.0}
    lost = seen[:, 4] == 0
    assert bool((seen[:, 3][lost] == 128 / 255).all())
