from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from cucumbervision_lab.datasets.coco import read_coco

SCRIPT = Path(__file__).with_name("teaching_house.py")


@pytest.mark.train
def test_a_drawn_house_is_measured_corrected_and_becomes_a_set(tmp_path: Path) -> None:
    pytest.importorskip("ultralytics")
    spec = importlib.util.spec_from_file_location("teaching_house", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    house = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(house)
    house.draw_house(tmp_path / "house", 2)
    (made,) = house.correct_house(tmp_path, [1])
    (done,) = house.correct_house(tmp_path, [1])  # nothing is done twice
    assert made == done
    pictures = read_coco(made).pictures
    assert pictures
    for picture in pictures:
        true = house.true_fruit(tmp_path / "house", picture.extras["capture"])
        masks = [label.mask for label in true]
        # Every label is a fruit: wrong finds were rejected, missed ones added where SAM could.
        assert picture.labels
        for label in picture.labels:
            assert not label.ignore
            assert max(house.mask_iou(label.mask, mask) for mask in masks) >= house.GOOD_MASK
