from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision_lab.data.labels import Label
from cucumbervision_lab.train.network import _with_axis_points, open_sets, write_training_data


def test_sets_are_written_once_and_count_as_often_as_given(seg_set: Path, tmp_path: Path) -> None:
    (dataset,) = open_sets([seg_set.parent])
    other = replace(dataset)
    written = write_training_data([dataset, other, dataset], "seg", tmp_path)
    values = yaml.safe_load(written.read_text())
    first, second = (str(tmp_path / "data" / str(k) / "images") for k in range(2))
    assert values == {
        "train": [f"{first}/train", f"{first}/train", f"{second}/train"],
        "val": [f"{first}/val", f"{second}/val"],
        "names": {0: "cucumber"},
    }
    assert "| not stated | not stated | 8 | 8 | 8 |" in (tmp_path / "data.md").read_text()


def test_keypoints_are_ordered_by_place_and_hidden_ones_unlabelled(
    pose_set: Path, tmp_path: Path
) -> None:
    (dataset,) = open_sets([pose_set.parent])
    points = np.array([[80, 20, 2], [65, 30, 2], [50, 40, 2], [35, 50, 2], [20, 60, 1]], float)
    picture = replace(
        dataset.pictures[0], labels=(Label(np.array([10.0, 10, 90, 70]), keypoints=points),)
    )
    assert picture.split == "train"
    changed = replace(dataset, pictures=(picture, *dataset.pictures[1:]))
    write_training_data([changed], "pose", tmp_path)
    (line,) = (
        (tmp_path / "data/0/labels/train" / f"{Path(picture.file).stem}.txt")
        .read_text()
        .splitlines()
    )
    x, y, seen = np.array(line.split()[5:], float).reshape(5, 3).T
    assert seen.tolist() == [0, 2, 2, 2, 2]
    assert (np.diff(x[1:]) > 0).all()
    assert (np.diff(y[1:]) < 0).all()


def test_what_is_ignored_is_painted_grey_but_not_the_fruit_in_it(
    seg_set: Path, tmp_path: Path
) -> None:
    (dataset,) = open_sets([seg_set.parent])
    picture = dataset.pictures[0]
    around = Label(np.array([9.5, 9.5, 79.5, 79.5]), ignore=True)
    painted = replace(picture, labels=(*picture.labels, around))
    write_training_data(
        [replace(dataset, pictures=(painted, *dataset.pictures[1:]))], "seg", tmp_path
    )
    before = read_color(dataset.path(picture))
    after = read_color(tmp_path / "data/0/images/train" / Path(picture.file).name)
    fruit = picture.labels[0].mask
    assert fruit is not None
    assert (after[fruit] == before[fruit]).all()
    inside = np.zeros(fruit.shape, bool)
    inside[10:80, 10:80] = True
    assert (after[inside & ~fruit] == 114).all()
    assert (after[~inside] == before[~inside]).all()


def test_a_set_of_two_classes_or_without_validation_is_refused(
    seg_set: Path, tmp_path: Path
) -> None:
    (dataset,) = open_sets([seg_set.parent])
    with pytest.raises(TrainingError, match="has 2 classes, expected 1"):
        write_training_data([replace(dataset, categories=("cucumber", "leaf"))], "seg", tmp_path)
    only = tuple(replace(picture, split="train") for picture in dataset.pictures)
    with pytest.raises(TrainingError, match="split val is missing"):
        write_training_data([replace(dataset, pictures=only)], "seg", tmp_path)


def test_complete_fruit_get_keypoints_along_their_axis() -> None:
    mask = np.zeros((60, 120), bool)
    mask[20:36, 10:110] = True
    known = _with_axis_points(Label.of_mask(mask, extras={"stem": "left"})).keypoints
    by_place = _with_axis_points(Label.of_mask(mask))
    assert known is not None
    assert by_place.keypoints is not None
    assert known[0, 0] > known[-1, 0]
    assert by_place.keypoints[0, 0] < by_place.keypoints[-1, 0]
    assert by_place.extras == {"keypoint_order": "place"}
    for label in (Label.of_mask(mask, cut_off=True), Label.of_mask(mask, hidden_share=0.2)):
        assert _with_axis_points(label).keypoints is None
