"""Crops of fruit to train on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.errors import TrainingError
from cucumbervision.fruit.crops import HEIGHT_PX, WIDTH_PX, FruitCrop, fruit_crop
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate
from cucumbervision_lab.train.fruit_crops import (
    SURROUND_PX,
    _row,
    collect_fruit_crops,
    collect_sets,
    outline_in_crop,
)

MASK = np.zeros((200, 400), bool)
MASK[90:110, 100:300] = True
POINTS = np.column_stack([np.linspace(299, 100, 5), np.full(5, 99.5), [2, 2, 2, 2, 1]])
MIDDLE = np.array([(SURROUND_PX[1] - WIDTH_PX) / 2, (SURROUND_PX[0] - HEIGHT_PX) / 2])


def _crop() -> FruitCrop:
    color = np.zeros((*MASK.shape, 3), np.uint8)
    crop = fruit_crop(color, None, MASK, None, SURROUND_PX)
    assert crop is not None
    return crop


def _instance() -> Instance:
    return Instance(box_of_mask(MASK), 0.7, detector_mask=MASK)


def _picture(*labels: Label) -> LabelledPicture:
    return LabelledPicture("a.png", 400, 200, labels, "a", "train")


def test_an_outline_covers_the_area_of_its_mask() -> None:
    crop = _crop()
    outline = outline_in_crop(crop, MASK)
    area_px = outline.sum() / 255 * crop.step_px**2
    assert area_px == pytest.approx(MASK.sum(), rel=0.01)


def test_keypoints_run_from_left_to_right_and_tell_where_the_stem_is() -> None:
    label = Label.of_mask(MASK, keypoints=POINTS)
    crop = _crop()
    _, outline, known, points, visible, stem, is_fruit = _row(
        crop, _instance(), True, _picture(label)
    )
    assert known
    assert is_fruit == 1
    assert (np.diff(points[:, 0]) > 0).all()
    # The keypoints run from the right to the left of the picture, unless the crop is turned.
    turned = crop.along[0] < 0
    assert stem == float(turned)
    assert visible.tolist() == ([1, 1, 1, 1, 0] if turned else [0, 1, 1, 1, 1])
    ends = np.rint(points[[0, -1]] + MIDDLE).astype(int)
    for column, row in ends:
        assert outline[row, column + (4 if column < 144 else -4)] > 200


def test_what_is_no_fruit_has_an_empty_outline_and_what_is_not_known_none() -> None:
    for is_fruit, known in ((False, True), (None, False)):
        row = _row(_crop(), _instance(), is_fruit, _picture())
        assert row[1].sum() == 0
        assert row[2] is known
        assert np.isnan(row[3]).all()


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    folder = tmp_path_factory.mktemp("drawn")
    frame = FrameOptions(640, 360, (0.0, 1.0, 0.0))
    return generate(SynthOptions(6, seed=5, frame=frame, split="train"), folder)


def test_detections_of_drawn_fruit_come_with_their_truth(drawn: DataSet) -> None:
    crops = collect_fruit_crops(drawn)
    fruit = crops[crops.is_fruit == 1]
    assert len(fruit.planes) > 3
    given, true = fruit.planes[..., 5] > 127, fruit.outlines > 127
    ious = (given & true).sum((1, 2)) / (given | true).sum((1, 2))
    assert np.median(ious) > 0.8
    assert (fruit.planes[..., 4] > 0).any((1, 2)).all()  # depth was read


def test_an_interrupted_collection_goes_on(drawn: DataSet, tmp_path: Path) -> None:
    pictures = tuple(
        replace(picture, scene=f"scene {k}", split="val" if k < 3 else "train")
        for k, picture in enumerate(drawn.pictures)
    )
    data = replace(drawn, pictures=pictures)
    ticks: list[int] = []
    crops = collect_sets([data], tmp_path, ticks.append)
    (file,) = tmp_path.iterdir()
    written = file.stat().st_mtime_ns
    again = collect_sets([data], tmp_path)
    assert file.stat().st_mtime_ns == written
    assert sum(ticks) == len(pictures)
    np.testing.assert_array_equal(again.planes, crops.planes)
    assert set(crops.held_out) == {True, False}


def test_one_scene_alone_is_too_few(drawn: DataSet, tmp_path: Path) -> None:
    train = tuple(replace(picture, split="val") for picture in drawn.pictures)
    with pytest.raises(TrainingError, match="too few scenes"):
        collect_sets([replace(drawn, pictures=train)], tmp_path)
