"""Regions to ignore in training: written, read, carried through a batch, left out of the loss."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

if importlib.util.find_spec("ultralytics") is None:
    pytest.skip("the extra train is not installed", allow_module_level=True)

from cucumbervision_lab.datasets.labels import Label
from cucumbervision_lab.datasets.yolo import write_yolo
from cucumbervision_lab.training.checkpoint import import_ultralytics
from cucumbervision_lab.training.losses import (
    add_ignored,
    ignore_regions,
    read_ignored,
    separate_ignored,
)

pytestmark = pytest.mark.train


def test_regions_are_written_beside_the_labels_and_joined_to_them(
    make_set: Any, tmp_path: Path
) -> None:
    dataset = make_set("train val")
    heap = Label(np.array([39.5, 9.5, 79.5, 39.5]), ignore=True)
    pictures = tuple(replace(p, labels=(*p.labels, heap)) for p in dataset.pictures)
    width, height = pictures[0].width, pictures[0].height
    written = write_yolo(replace(dataset, pictures=pictures), tmp_path / "yolo")
    (outline,) = read_ignored(tmp_path / "yolo/ignored/train/000000.txt")
    np.testing.assert_allclose(
        outline * [width, height], [[40, 10], [80, 10], [80, 40], [40, 40]], atol=1e-3
    )
    read = _read(written.data_yaml, "segment", {"names": {0: "cucumber"}, "nc": 1, "channels": 3})
    fruit = len(read.labels[0]["cls"])
    add_ignored(read, "segment")
    label = read.labels[0]
    assert label["cls"].ravel().tolist() == [0.0] * fruit + [1.0]
    np.testing.assert_allclose(
        label["bboxes"][-1] * [width, height, width, height], [60, 25, 40, 30], rtol=1e-5
    )
    assert len(label["segments"]) == fruit + 1
    batch = read.collate_fn([read[0]])
    batch["img"] = batch["img"].float()
    own = separate_ignored(batch)
    assert own["ignored"].any()
    assert own["cls"].unique().tolist() == [0.0]
    assert not (own["ignored"] & (own["masks"] > 0)).any()


def _read(data: Path, task: str, values: dict[str, Any]) -> Any:
    import_ultralytics()
    from ultralytics.data.dataset import YOLODataset
    from ultralytics.utils import DEFAULT_CFG

    folder = data.parent / "images" / "train"
    return YOLODataset(
        img_path=str(folder), data=values, task=task, imgsz=160, augment=False, hyp=DEFAULT_CFG
    )


def _batch(**rows: Any) -> dict[str, Any]:
    import torch

    return {
        "img": torch.zeros(2, 3, 32, 32),
        "batch_idx": torch.tensor([0.0, 0.0, 0.0]),
        "cls": torch.tensor([[0.0], [1.0], [0.0]]),
        "bboxes": torch.tensor(
            [[0.25, 0.25, 0.25, 0.25], [0.5, 0.5, 1.0, 1.0], [0.75, 0.75, 0.25, 0.25]]
        ),
        **rows,
    }


def test_fruit_that_stay_in_a_batch_are_counted_anew() -> None:
    import torch

    masks = torch.zeros(2, 8, 8, dtype=torch.uint8)
    masks[0] = 2
    masks[0, 1:3, 1:3], masks[0, 5:7, 5:7] = 1, 3
    own = separate_ignored(_batch(masks=masks, sem_masks=(masks == 2).float()))
    assert own["batch_idx"].tolist() == [0, 0]
    assert own["bboxes"][:, 0].tolist() == [0.25, 0.75]
    assert own["masks"][0, 1:3, 1:3].unique().tolist() == [1]
    assert own["masks"][0, 5:7, 5:7].unique().tolist() == [2]
    assert own["ignored"][0].sum() == 64 - 8
    assert not own["ignored"][1].any()
    assert not own["sem_masks"].any()


def test_without_masks_fruit_keep_their_boxes() -> None:
    import torch

    own = separate_ignored(_batch(keypoints=torch.ones(3, 5, 3)))
    assert own["keypoints"].shape == (2, 5, 3)
    assert own["ignored"][0].sum() == 64 - 8


@pytest.mark.parametrize("task", ["segment", "pose"])
def test_what_is_predicted_in_a_region_costs_nothing(task: str) -> None:
    import torch

    import_ultralytics()
    from ultralytics.cfg import get_cfg
    from ultralytics.nn.tasks import PoseModel, SegmentationModel

    torch.manual_seed(0)
    short = {"segment": "seg", "pose": "pose"}[task]
    kinds: dict[str, Any] = {"segment": SegmentationModel, "pose": PoseModel}
    model = kinds[task](f"yolo26n-{short}.yaml", nc=1, verbose=False)
    model.args = get_cfg(overrides={"task": task})
    model.criterion = model.init_criterion()
    for head in (model.criterion.one2many, model.criterion.one2one):
        ignore_regions(head)
    picture = torch.rand(1, 3, 64, 64)
    batch: dict[str, Any] = {
        "img": picture,
        "batch_idx": torch.zeros(0),
        "cls": torch.zeros(0, 1),
        "bboxes": torch.zeros(0, 4),
        "keypoints": torch.zeros(0, *model.model[-1].kpt_shape) if task == "pose" else None,
        "masks": torch.zeros(1, 16, 16),
        "sem_masks": torch.zeros(1, 16, 16),
    }

    def cost(region: Any) -> float:
        _, items = model.loss(batch | ({} if region is None else {"ignored": region}))
        return float(items["cls_loss"])

    everywhere = torch.ones(1, 16, 16, dtype=torch.bool)
    half = everywhere.clone()
    half[:, :, 8:] = False
    whole = cost(None)
    assert whole > 0
    assert cost(torch.zeros_like(everywhere)) == whole
    assert cost(everywhere) == 0
    assert 0 < cost(half) < whole
