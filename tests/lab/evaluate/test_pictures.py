from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import write_png
from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.evaluate.pictures import capture_of, frame_of, read_held_out

BOX = np.array([9.5, 9.5, 29.5, 19.5])


def write_set(folder: Path, pictures: list[LabelledPicture]) -> Path:
    for picture in pictures:
        path = folder / "raw" / picture.file
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.zeros((picture.height, picture.width, 3), np.uint8))
    write_coco(DataSet(folder / "raw", tuple(pictures)), folder / "set")
    return folder / "set"


def picture(name: str, *labels: Label, split: str = "test") -> LabelledPicture:
    return LabelledPicture(f"images/{name}.png", 64, 48, labels, name, split, "synth")


def test_pseudo_labels_are_no_test(tmp_path: Path) -> None:
    drawn = Label(BOX, pseudo=True)
    pictures = [picture("a", Label(BOX)), picture("b", drawn), picture("c", drawn, split="train")]
    folder = write_set(tmp_path, pictures)
    with pytest.raises(
        DataSetError, match=r"1 pictures.*first images/b\.png; move them to 'train'"
    ):
        read_held_out(folder)


def test_a_split_without_pictures_is_refused(tmp_path: Path) -> None:
    folder = write_set(tmp_path, [picture("a", split="train"), picture("b", split="val")])
    with pytest.raises(DataSetError, match=r"split 'test' is empty \(available: train, val\)"):
        read_held_out(folder)
    assert len(read_held_out(folder, "all").pictures) == 2


def test_a_set_that_cannot_be_read_in_full_is_refused(tmp_path: Path) -> None:
    folder = write_set(tmp_path, [picture("a", Label(BOX))])
    text = (folder / "annotations.json").read_text().replace('"category_id": 1', '"category_id": 9')
    (folder / "annotations.json").write_text(text)
    with pytest.raises(DataSetError, match="annotation 1: its category 9 is not listed"):
        read_held_out(folder)


def test_pictures_that_are_not_those_labelled_are_refused(tmp_path: Path) -> None:
    folder = write_set(tmp_path, [picture(name) for name in "abc"])
    images = folder / "images"
    (images / "a.png").unlink()
    (images / "b.png").unlink()
    write_png(images / "b.png", np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(DataSetError, match=r"images/a\.png: the file is missing.*\(and 1 more\)"):
        read_held_out(folder)
    (images / "a.png").write_bytes(b"no picture")
    with pytest.raises(DataSetError, match=r"a\.png: is not a readable picture"):
        read_held_out(folder)


def test_classes_beside_cucumber() -> None:
    labels = tuple(Label(BOX, category=k) for k in range(3))
    data = DataSet(Path(), (), ("Cucumber", "zucchini", "banana"))
    true = frame_of(picture("a", *labels), data, None).true
    assert [(one.required, one.optional) for one in true] == [(True, False), (False, True)]
    ignored = frame_of(picture("a", Label(BOX, category=2, ignore=True)), data, None).true
    assert [one.ignore for one in ignored] == [True]
    only = frame_of(picture("a", Label(BOX)), DataSet(Path(), (), ("fruit",)), None).true
    assert only[0].required


def test_distance_comes_from_the_label_or_else_from_depth() -> None:
    mask = np.zeros((48, 64), bool)
    mask[10:20, 10:30] = True
    depth = np.full((48, 64), 3.0, np.float32)
    depth[10:20, 10:30] = 0.6
    depth[12, 12] = 0.0
    data = DataSet(Path(), ())
    told = Label.of_mask(mask, extras={"distance_m": 0.61, "centreline_m": 0.2})
    for label, distance in ((told, 0.61), (replace(told, extras={}), 0.6)):
        (fruit,) = frame_of(picture("a", label), data, depth).true
        assert fruit.distance_m == pytest.approx(distance)
    assert np.isnan(frame_of(picture("a", replace(told, extras={})), data, None).true[0].distance_m)


def test_capture_needs_depth_and_camera(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    write_png(tmp_path / "depth" / "a.png", np.full((48, 64), 512, np.uint16))
    color = np.zeros((48, 64, 3), np.uint8)
    data = DataSet(tmp_path, ())
    one = replace(
        picture("a"),
        depth_file="depth/a.png",
        depth_unit_m=0.001,
        camera=Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0),
    )
    capture = capture_of(one, data, color)
    assert capture is not None
    assert capture.depth_m[0, 0] == pytest.approx(0.512)
    assert capture.simulated
    assert capture_of(replace(one, camera=None), data, color) is None
    assert capture_of(replace(one, depth_file=None), data, color) is None
