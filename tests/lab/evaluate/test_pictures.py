from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import DataSetError
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.networks.find import NetworkLoader
from cucumbervision.networks.registry import load_registry
from cucumbervision.networks.yolo import YoloDetector
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.evaluate.pictures import (
    Frame,
    Networks,
    capture_of,
    detect_picture,
    frame_of,
    open_networks,
    read_held_out,
)
from cucumbervision_lab.evaluate.scenes import found_by_fruit

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


class Replay:
    """A detector that has looked already, at one size."""

    looks = 1
    task = "segment"

    def __init__(self, *found: Instance) -> None:
        self._found = found

    def detect(
        self, color_rgb: NDArray[np.uint8], confidence: float | None = None
    ) -> tuple[Instance, ...]:
        return self._found


def test_what_is_judged_is_what_ships() -> None:
    """The networks of the package, on the bundled captures: the same fruit, equally sure."""
    ours = NetworkLoader(full_precision=True).detectors()
    judged = open_networks(None, None, None)
    for ref in open_source(example_captures()):
        capture = ref.load()
        color, (height, width) = capture.color, capture.color.shape[:2]
        frame = Frame(capture.name, capture.name, width, height)
        focal_px = capture.intrinsics.fx_px
        found = ours.find(color, capture.depth_m, focal_px)
        _, kept, _ = detect_picture(frame, color, judged, capture.depth_m, focal_px)
        assert len(found) > 0
        assert len(kept) == len(found)
        for one, other in zip(kept, found, strict=True):
            assert one.box == pytest.approx(other.box, abs=0.1)
            assert one.confidence == pytest.approx(other.confidence, abs=0.01)


def test_a_file_is_judged_by_itself_or_beside_the_networks_in_use() -> None:
    file = load_registry().resolve("cucumber-seg")["network"]
    pose = load_registry().resolve("cucumber-pose")["network"]
    alone = open_networks(file, "cucumber-pose", None)
    in_use = open_networks(file, "cucumber-pose", None, as_in_use=True)
    assert alone.fruit is None
    assert in_use.fruit is not None
    # Somebody's own pose network gives the keypoints.
    assert open_networks(file, pose, None, as_in_use=True).fruit is None


def test_of_low_confidence_is_ranked_and_not_reported() -> None:
    sure, unsure = np.zeros((40, 120), bool), np.zeros((40, 120), bool)
    sure[10:20, 10:50] = unsure[25:35, 60:110] = True
    replay = Replay(
        Instance(box_of_mask(sure), 0.9, detector_mask=sure),
        Instance(box_of_mask(unsure), 0.05, detector_mask=unsure),
    )
    heap = Label(np.array([80.0, 0.0, 119.0, 8.0]), ignore=True)
    labels = (heap, *(Label(box_of_mask(mask)) for mask in (unsure, sure)))
    networks = Networks(cast(YoloDetector, replay), None, None, 0.3)
    frame = Frame("a.png", "a", 120, 40, labels)
    frame, kept, seconds = detect_picture(frame, np.zeros((40, 120, 3), np.uint8), networks)
    assert [one.score for one in frame.segmented] == [0.9, 0.05]
    assert [one.score for one in frame.kept] == [0.9]
    assert list(seconds) == ["segment"]
    # By the index of the label that it was found for.
    assert found_by_fruit(frame, kept, 0.3) == {2: kept[0]}
    assert found_by_fruit(frame, kept, 0.95) == {}
