"""The page on data sets: its keys are those that are written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from cucumbervision.fruit.instance import KEYPOINT_NAMES
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet

PAGE = Path(__file__).parents[3] / "docs" / "datasets.md"
COCO_KEYS = {"id", "image_id", "file_name", "width", "height", "category_id", "bbox", "area",
             "iscrowd", "segmentation", "keypoints", "num_keypoints"}  # fmt: skip


def test_every_key_is_described(make_set: Callable[..., DataSet]) -> None:
    page = PAGE.read_text(encoding="utf-8")
    dataset = make_set("train")
    label = replace(dataset.pictures[0].labels[0], pseudo=True)
    picture = replace(dataset.pictures[0], labels=(label,))
    write_coco(replace(dataset, pictures=(picture,)), dataset.folder)
    data = json.loads((dataset.folder / "annotations.json").read_text())
    for item in (*data["images"], *data["annotations"]):
        for key in set(item) - COCO_KEYS:
            assert f"`{key}`" in page, key
    assert all(f"`{name}`" in page for name in KEYPOINT_NAMES)
