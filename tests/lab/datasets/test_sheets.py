from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.files import read_color
from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.datasets.sheets import shrunk_label, write_sheets


def a_set(folder: Path, count: int = 5) -> DataSet:
    """Draw a red bar on white, lower in each picture, and one region to ignore."""
    (folder / "images").mkdir(parents=True)
    pictures = []
    for k in range(count):
        mask = np.zeros((120, 240), bool)
        mask[20 * k : 20 * k + 12, 60:180] = True
        color = np.where(mask[..., None], (200, 10, 10), (250, 250, 250)).astype(np.uint8)
        cv2.imwrite(str(folder / f"images/{k}.png"), color[..., ::-1])
        labels = (Label.of_mask(mask), Label(np.array([-0.5, -0.5, 19.5, 9.5]), ignore=True))
        pictures.append(LabelledPicture(f"images/{k}.png", 240, 120, labels, f"s{k}", "train"))
    return DataSet(folder, tuple(pictures))


def test_fruit_lie_on_a_sheet_where_their_masks_say(tmp_path: Path) -> None:
    made = write_sheets(a_set(tmp_path / "set"), tmp_path / "out", 3, 480, seed=1)
    assert all(len(picture.labels) in (2 * 4, 2 * 9) for picture in made.pictures)
    for picture in made.pictures:
        color = read_color(made.path(picture)).astype(int)
        red = (color[..., 0] > 120) & (color[..., 1] < 110)
        masks = [label.mask for label in picture.labels if not label.ignore]
        union = np.any([mask for mask in masks if mask is not None], axis=0)
        assert (red & union).sum() / (red | union).sum() > 0.85
        sizes = {round(float(x.box[2] - x.box[0])) for x in picture.labels if not x.ignore}
        # Two by two a picture of 240 px has 240, three by three 160.
        assert sizes == ({120} if len(masks) == 4 else {80})
        assert (picture.width, picture.height, picture.split) == (480, 480, "train")


def test_every_picture_is_used_before_one_comes_again(tmp_path: Path) -> None:
    data = a_set(tmp_path / "set", 4)
    made = write_sheets(data, tmp_path / "out", 1, 480, seed=3)
    (sheet,) = made.pictures
    rows = sorted(round(float(label.box[1])) for label in sheet.labels if not label.ignore)
    count = len(rows)
    # Four pictures with bars at four heights, two by two: each height once in its cell.
    assert count in (4, 9)
    cells = {round(row % (480 / count**0.5)) for row in rows}
    assert len(cells) == 4


def test_points_and_boxes_shrink_with_the_picture() -> None:
    mask = np.zeros((40, 80), bool)
    mask[10:20, 20:60] = True
    points = np.array(
        [[19.5, 14.5, 2], [29.5, 14.5, 2], [39.5, 14.5, 1], [49.5, 14.5, 2], [0, 0, 0]]
    )
    label = Label.of_mask(mask, keypoints=points, extras={"chord_m": 0.2})
    small = shrunk_label(label, (0.5, 0.5), (100, 50), 200)
    assert small.keypoints is not None
    np.testing.assert_allclose(small.keypoints[0], [109.5, 57.0, 2])
    assert small.mask is not None
    assert (int(small.mask.sum()), dict(small.extras)) == (5 * 20, {})
    assert not small.ignore
    assert shrunk_label(label, (0.1, 0.1), (0, 0), 200).ignore  # four pixels are left


def test_an_empty_split_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataSetError, match="no pictures in val"):
        write_sheets(a_set(tmp_path / "set"), tmp_path / "out", 1, split="val")
