from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.pictures import write_png
from cucumbervision.networks.find import NetworkSegmenter, open_segmenter
from cucumbervision_lab.data.checks import check_dataset
from cucumbervision_lab.data.derive import add_pseudo_masks
from cucumbervision_lab.data.labels import DataSet, Label

MakeSet = Callable[..., DataSet]
BOX = np.array([29.5, 39.5, 129.5, 79.5])


@pytest.fixture(scope="module")
def segmenter() -> NetworkSegmenter:
    return open_segmenter("mobile-sam", full_precision=True)


def boxed(make_set: MakeSet) -> DataSet:
    """Two pictures of a green bar on brown, with its box and another where nothing is."""
    dataset = make_set("train test")
    color = np.full((120, 160, 3), (120, 80, 50), np.uint8)
    color[40:80, 30:130] = (40, 140, 50)
    pictures = []
    for picture in dataset.pictures:
        write_png(dataset.path(picture), color)
        labels = (Label(BOX), Label(np.array([5.0, 5, 25, 20]), ignore=True), picture.labels[0])
        pictures.append(replace(picture, labels=labels))
    return replace(dataset, pictures=tuple(pictures))


def test_boxes_get_masks_in_train_only(make_set: MakeSet, segmenter: NetworkSegmenter) -> None:
    dataset = boxed(make_set)
    seen: list[int] = []
    drawn, refused = add_pseudo_masks(dataset, segmenter, progress=seen.append)
    assert (refused, seen) == ([], [1, 1])
    train, test = drawn.pictures
    mask = train.labels[0].mask
    assert mask is not None
    wanted = np.zeros((120, 160), bool)
    wanted[40:80, 30:130] = True
    assert (mask & wanted).sum() / (mask | wanted).sum() > 0.95
    assert train.labels[0].pseudo
    assert train.labels[0].box.tolist() == BOX.tolist()
    # What is to be ignored and what has a mask stay as they are.
    assert train.labels[1:] == dataset.pictures[0].labels[1:]
    assert test is dataset.pictures[1]
    (finding,) = check_dataset(drawn, duplicates=False)
    assert "no picture is in val" in str(finding)


def test_a_mask_that_does_not_fit_is_to_be_ignored(
    make_set: MakeSet, segmenter: NetworkSegmenter
) -> None:
    dataset = boxed(make_set)
    picture = dataset.pictures[0]
    small = Label(np.array([60.0, 55.0, 66.0, 60.0]))
    drawn, refused = add_pseudo_masks(
        replace(dataset, pictures=(replace(picture, labels=(small,)),)), segmenter
    )
    ((file, fault),) = refused
    assert file == picture.file
    assert fault in {"mask-empty", "mask-small", "mask-off-box"}
    label = drawn.pictures[0].labels[0]
    assert (label.ignore, label.pseudo, label.mask_code) == (True, False, None)
