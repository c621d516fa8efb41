from pathlib import Path

import cv2
import numpy as np

from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.scenes.paste import cutouts_of

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
