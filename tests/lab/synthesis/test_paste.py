from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from cucumbervision.perception.yolo_layout import BY_PLACE
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import KEYPOINT_ORDER, DataSet, Label, LabelledPicture
from cucumbervision_lab.synthesis.paste import Cutout, cutouts_of, paste

RED = (250, 10, 10)


def red_bar() -> Cutout:
    color = np.full((30, 120, 3), RED, np.uint8)
    mask = np.zeros((30, 120), bool)
    mask[5:25, 5:115] = True
    points = np.array([[5.0, 15, 2], [32, 15, 2], [60, 15, 2], [87, 15, 2], [114, 15, 2]])
    return Cutout(color, mask, points)


def test_a_pasted_fruit_is_seen_where_its_mask_says() -> None:
    grey = np.full((240, 320, 3), 120, np.uint8)
    behind = np.full((240, 320), 1.0)
    for seed in range(8):
        color, labels = paste(grey, behind, (), [red_bar()], 1, np.random.default_rng(seed))
        (label,) = labels
        mask, amodal, points = label.mask, label.amodal, label.keypoints
        assert mask is not None
        assert amodal is not None
        assert points is not None
        assert label.pseudo
        changed = np.abs(color.astype(int) - 120).sum(axis=2) > 60
        assert (changed & mask).sum() / (changed | mask).sum() > 0.9
        assert label.hidden_share == 0  # nothing stands before it
        # The keypoints went along: all that are inside the picture lie on the fruit.
        for u, v, seen in points:
            if seen == 2 and 2 < u < 317 and 2 < v < 237:
                assert amodal[round(v) - 2 : round(v) + 3, round(u) - 2 : round(u) + 3].any()


def test_a_fruit_of_whose_ends_nobody_knows_keeps_saying_so() -> None:
    grey, behind = np.full((240, 320, 3), 120, np.uint8), np.full((240, 320), 1.0)
    for by_place, order in ((True, BY_PLACE), (False, None)):
        bar = replace(red_bar(), by_place=by_place)
        _, (label,) = paste(grey, behind, (), [bar], 1, np.random.default_rng(1))
        assert label.extras.get(KEYPOINT_ORDER) == order


def test_what_stands_nearer_hides_it_and_what_is_behind_is_hidden() -> None:
    grey = np.full((240, 320, 3), 120, np.uint8)
    depth = np.full((240, 320), 1.0)
    depth[:, 150:170] = 0.1  # a post before everything
    own = np.zeros((240, 320), bool)
    own[20:220, 60:290] = True
    own[:, 150:170] = False
    label = Label.of_mask(own, amodal=own)
    covered = posted = 0
    for seed in range(20):
        color, labels = paste(grey, depth, (label,), [red_bar()], 1, np.random.default_rng(seed))
        np.testing.assert_array_equal(color[:, 152:168], 120)
        if len(labels) < 2:
            continue
        before, fresh = labels[0], labels[1]
        assert before.mask is not None
        assert fresh.mask is not None
        assert not (before.mask & fresh.mask).any()
        assert before.hidden_share is not None or not (own & fresh.mask).any()
        covered += int(before.mask.sum() < own.sum())
        posted += int((fresh.hidden_share or 0) > 0.02)
    assert covered > 5
    assert posted > 2


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
