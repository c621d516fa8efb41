from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.coco import read_coco
from cucumbervision_lab.datasets.labels import KEYPOINT_ORDER, DataSet, Label, LabelledPicture
from cucumbervision_lab.datasets.windows import (
    Window,
    choose_windows,
    crop_label,
    shrunk_label,
    write_sheets,
    write_windows,
)

WIDTH, HEIGHT = 200, 120


def bar(left: int, right: int, top: int = 50, bottom: int = 60) -> Label:
    """Give a level fruit with five points along it, 50 px high up."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top:bottom, left:right] = True
    points = np.full((5, 3), 2.0)
    points[:, 0] = np.linspace(left, right - 1, 5)
    points[:, 1] = (top + bottom - 1) / 2
    return Label.of_mask(mask, amodal=mask, keypoints=points, extras={"centreline_m": 0.2})


def picture_of(*labels: Label, split: str = "train") -> LabelledPicture:
    return LabelledPicture("images/a.png", WIDTH, HEIGHT, labels, "house", split)


@pytest.mark.parametrize("seed", range(8))
def test_every_fruit_lies_whole_in_a_window_and_none_leaves_the_picture(seed: int) -> None:
    labels = (bar(0, 30), bar(10, 110, 80, 95), bar(150, 200), bar(60, 95, 0, 12))
    windows = choose_windows(np.random.default_rng(seed), picture_of(*labels), 64)
    for window in windows:
        assert 0 <= window.left <= window.left + window.width <= WIDTH
        assert 0 <= window.top <= window.top + window.height <= HEIGHT
        assert min(window.width, window.height) >= 64
    for label in labels:
        assert label.mask is not None
        kept = [label.mask[window.slices].sum() for window in windows]
        assert max(kept) >= 0.9 * label.mask.sum()


def test_a_long_fruit_gets_a_window_of_its_size_and_a_small_picture_one_of_its_own() -> None:
    rng = np.random.default_rng(1)
    (window,) = choose_windows(rng, picture_of(bar(20, 140)), 64)
    assert (window.width, window.height) == (150, HEIGHT)
    (window,) = choose_windows(rng, picture_of(bar(20, 40)), 400)
    assert window == Window(0, 0, WIDTH, HEIGHT)


def test_a_picture_without_fruit_gives_one_window() -> None:
    ignored = Label(np.array([10.0, 10.0, 30.0, 30.0]), ignore=True)
    (window,) = choose_windows(np.random.default_rng(2), picture_of(ignored), 64)
    assert (window.width, window.height) == (64, 64)


def test_what_is_left_of_a_fruit_in_a_window() -> None:
    whole = crop_label(bar(100, 141), Window(90, 40, 64, 64))
    assert whole is not None
    assert whole.box.tolist() == [9.5, 9.5, 50.5, 19.5]
    assert whole.keypoints is not None
    assert whole.keypoints[:, 0].tolist() == [10.0, 20.0, 30.0, 40.0, 50.0]
    assert not whole.cut_off
    assert whole.extras == {"centreline_m": 0.2}
    half = crop_label(bar(100, 141), Window(120, 40, 64, 64))
    assert half is not None
    assert half.mask is not None
    assert half.mask.sum() == 21 * 10
    # Points at 100, 110 are left of it; 120 is its first column.
    assert half.keypoints is not None
    assert half.keypoints[:, 2].tolist() == [0.0, 0.0, 2.0, 2.0, 2.0]
    assert half.cut_off
    assert not half.ignore
    assert half.extras == {}
    sliver = crop_label(bar(100, 141), Window(136, 40, 64, 64))
    assert sliver is not None
    assert sliver.ignore
    assert crop_label(bar(100, 141), Window(0, 0, 64, 64)) is None


def test_boxes_alone_are_cut_too() -> None:
    label = Label(np.array([99.5, 49.5, 139.5, 59.5]))
    part = crop_label(label, Window(110, 40, 64, 64))
    assert part is not None
    assert part.box.tolist() == [-0.5, 9.5, 29.5, 19.5]
    assert part.mask is None
    assert part.cut_off


def test_written_windows_read_back_with_the_pixels_of_the_picture(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    grey = rng.integers(0, 255, (HEIGHT // 8, WIDTH // 8), np.uint8)
    smooth = cv2.resize(grey, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    (tmp_path / "set" / "images").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "set" / "images" / "a.png"), smooth)
    pictures = (picture_of(bar(20, 61), bar(150, 180)), picture_of(bar(20, 61), split="test"))
    data = DataSet(tmp_path / "set", pictures)
    write_windows(data, tmp_path / "windows", 64)
    again = read_coco(tmp_path / "windows")
    assert {p.split for p in again.pictures} == {"train"}
    assert {p.scene for p in again.pictures} == {"house"}
    assert len(again.pictures) == 2
    for picture in again.pictures:
        color = read_color(again.path(picture))
        assert color.shape[:2] == (picture.height, picture.width) == (64, 64)
        # The fruit that lies whole in it tells where the window was.
        fruit = next(x for x in picture.labels if not x.cut_off)
        start = {41: 20, 30: 150}[round(fruit.box[2] - fruit.box[0])]
        left, top = start - round(fruit.box[0] + 0.5), 50 - round(fruit.box[1] + 0.5)
        shown = smooth[top : top + 64, left : left + 64].astype(int)
        assert np.abs(color[..., 0] - shown).mean() < 3
        assert np.abs(color[..., 0] - np.roll(shown, 9, axis=1)).mean() > 3
    first = write_windows(data, tmp_path / "again", 64)
    assert [p.labels[0].box.tolist() for p in first.pictures] == [
        p.labels[0].box.tolist() for p in again.pictures
    ]


def test_windows_too_small_to_see_anything_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataSetError, match="too small"):
        write_windows(DataSet(tmp_path, ()), tmp_path / "out", 8)


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
    label = Label.of_mask(mask, keypoints=points, extras={"chord_m": 0.2, KEYPOINT_ORDER: "place"})
    small = shrunk_label(label, (0.5, 0.5), (100, 50), 200)
    assert small.keypoints is not None
    np.testing.assert_allclose(small.keypoints[0], [109.5, 57.0, 2])
    assert small.mask is not None
    assert (int(small.mask.sum()), dict(small.extras)) == (5 * 20, {KEYPOINT_ORDER: "place"})
    assert not small.ignore
    assert shrunk_label(label, (0.1, 0.1), (0, 0), 200).ignore  # four pixels are left


def test_an_empty_split_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataSetError, match="no pictures in val"):
        write_sheets(a_set(tmp_path / "set"), tmp_path / "out", 1, split="val")
