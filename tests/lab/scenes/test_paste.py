from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate
from cucumbervision_lab.scenes.paste import Cutout, cutouts_of, fruitless, montage

RED = (250, 10, 10)


def test_only_whole_fruit_of_the_split_are_cut_out(tmp_path: Path) -> None:
    color = np.full((120, 200, 3), 90, np.uint8)
    color[40:60, 30:130] = RED
    cv2.imwrite(str(tmp_path / "a.png"), color[..., ::-1])
    mask = np.zeros((120, 200), bool)
    mask[40:60, 30:130] = True
    edge = np.zeros((120, 200), bool)
    edge[0:20, 0:80] = True
    labels = (Label.of_mask(mask), Label.of_mask(edge), Label.of_mask(mask, ignore=True))
    pictures = tuple(
        LabelledPicture("a.png", 200, 120, labels, scene=s, split=s) for s in ("train", "test")
    )
    data = write_coco(DataSet(tmp_path, pictures), tmp_path / "hub")
    (cutout,) = cutouts_of(data)
    assert cutout.mask.sum() == 18 * 98  # without its outermost pixels
    np.testing.assert_array_equal(cutout.color[cutout.mask], np.full((18 * 98, 3), RED))


SIZE = (480, 360)


FRAME = FrameOptions(320, 240, (1.0, 0.0, 0.0), depth=False)


def red_bar() -> Cutout:
    color = np.full((40, 160, 3), (230, 15, 15), np.uint8)
    mask = np.zeros((40, 160), bool)
    mask[6:34, 6:154] = True
    points = np.full((5, 3), 2.0)
    points[:, 0], points[:, 1] = np.linspace(6, 153, 5), 19.5
    return Cutout(color, mask, points)


def test_labels_say_what_is_seen() -> None:
    grey = np.full((500, 700, 3), 120, np.uint8)
    shown = 0
    for seed in range(12):
        color, labels = montage(grey, SIZE, [red_bar()], np.random.default_rng(seed))
        assert color.shape == (360, 480, 3)
        union = np.zeros(color.shape[:2], bool)
        for label in labels:
            assert label.pseudo
            assert label.mask is not None
            assert label.amodal is not None
            assert not (label.mask & union).any()  # no pixel is two fruit's
            assert (label.mask <= label.amodal).all()
            union |= label.mask
            shown += 1
        far = color.astype(int)
        red = (far[..., 0] > 1.7 * far[..., 1]) & (far[..., 0] > 40)
        if union.any():
            assert (red & union).sum() / (red | union).sum() > 0.8
    assert shown > 15


def test_what_is_bright_stands_in_front() -> None:
    ground = np.full((500, 700, 3), 60, np.uint8)
    ground[:, np.arange(700) % 40 < 14] = 240
    shares = []
    for seed in range(30):
        _, labels = montage(ground, SIZE, [red_bar()], np.random.default_rng(seed))
        shares += [label.hidden_share or 0.0 for label in labels]
        assert all(label.ignore for label in labels if (label.hidden_share or 0) > 0.88)
    assert sum(share > 0.1 for share in shares) > 15
    assert sum(share < 0.02 for share in shares) > 15


def test_only_large_pictures_without_labels_are_pasted_onto() -> None:
    wide = LabelledPicture("a.jpg", 640, 480)
    region = Label(np.array([0.0, 0.0, 9.0, 9.0]), ignore=True)
    assert fruitless(wide)
    assert not fruitless(LabelledPicture("a.jpg", 640, 480, (region,)))
    assert not fruitless(LabelledPicture("a.jpg", 640, 200))


def a_set(folder: Path, *, fruit: bool) -> Path:
    (folder / "raw").mkdir(parents=True)
    mask = np.zeros((400, 400), bool)
    mask[180:220, 100:300] = True
    color = np.full((400, 400, 3), 130, np.uint8)
    color[mask & fruit] = (230, 15, 15)
    cv2.imwrite(str(folder / "raw/a.png"), color[..., ::-1])
    labels = (Label.of_mask(mask),) if fruit else ()
    picture = LabelledPicture("a.png", 400, 400, labels, "s", "train", source="ours")
    write_coco(DataSet(folder / "raw", (picture,)), folder / "hub")
    return folder / "hub"


def test_a_set_is_made_by_synth_and_is_the_same_again(tmp_path: Path) -> None:
    options = SynthOptions(
        3,
        5,
        FRAME,
        split="train",
        paste=a_set(tmp_path / "fruit", fruit=True),
        onto=a_set(tmp_path / "ground", fruit=False),
    )
    made = generate(options, tmp_path / "one")
    assert [(p.split, p.source, p.width) for p in made.pictures] == [("train", "ours", 320)] * 3
    generate(options, tmp_path / "two")
    for picture in made.pictures:
        first, second = (read_color(tmp_path / k / picture.file) for k in ("one", "two"))
        np.testing.assert_array_equal(first, second)


def test_onto_needs_fruit_to_paste_and_trains_only(tmp_path: Path) -> None:
    for split, paste in (("train", None), ("test", tmp_path)):
        with pytest.raises(DataSetError, match="--onto"):
            SynthOptions(1, 1, FRAME, split=split, paste=paste, onto=tmp_path)
    fruit = a_set(tmp_path / "fruit", fruit=True)
    options = SynthOptions(1, 1, FRAME, split="train", paste=fruit, onto=fruit)
    with pytest.raises(DataSetError, match="no large training pictures without fruit"):
        generate(options, tmp_path / "out")
