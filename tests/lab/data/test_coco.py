from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.pictures import write_png
from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.coco import coco_entries, read_coco, write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture

MakeSet = Callable[..., DataSet]


def test_the_hub_form_gives_everything_back(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set()
    out = tmp_path / "hub"
    written = write_coco(dataset, out)
    back = read_coco(out)
    assert back.refused == ()
    assert back.categories == ("cucumber",)
    assert back.folder == written.folder == out
    for a, b in zip(dataset.pictures, back.pictures, strict=True):
        assert coco_entries(a)["annotations"] == coco_entries(b)["annotations"]
        assert (a.scene, a.split, a.camera, a.extras) == (b.scene, b.split, b.camera, b.extras)
        assert a.labels[0].mask_code == b.labels[0].mask_code
        assert back.path(b).read_bytes() == dataset.path(a).read_bytes()
        assert b.depth_file is not None
        assert (out / b.depth_file).is_file()


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools
def test_annotations_are_coco_for_other_tools(make_set: MakeSet) -> None:
    coco = pytest.importorskip("pycocotools.coco")
    dataset = make_set()
    write_coco(dataset, dataset.folder)
    data = coco.COCO(str(dataset.folder / "annotations.json"))
    label = dataset.pictures[0].labels[0]
    found = data.loadAnns(data.getAnnIds(imgIds=[1]))[0]
    assert (data.annToMask(found).astype(bool) == label.mask).all()
    # Columns 20 to 64, rows 40 to 55, counted from the corner.
    assert found["bbox"] == [20, 40, 45, 16]
    assert found["area"] == 45 * 16
    assert found["keypoints"][:3] == [20.5, 48.5, 2]
    assert found["num_keypoints"] == 4


def test_numbers_of_numpy_are_written_and_nan_is_refused(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set()

    def write(**extras: object) -> None:
        label = Label(np.array([1.0, 2, 30, 40]), extras=extras)
        picture = replace(dataset.pictures[0], labels=(label,))
        write_coco(replace(dataset, pictures=(picture,)), tmp_path / "out")

    write(radius_m=np.array([0.0, 0.02]))
    (annotation,) = json.loads((tmp_path / "out/annotations.json").read_text())["annotations"]
    assert annotation["extras"] == {"radius_m": [0.0, 0.02]}
    with pytest.raises(DataSetError, match="cannot be written as JSON"):
        write(thread_m=float("nan"))


def roboflow(folder: Path) -> None:
    """As Roboflow exports COCO: a group as category 0, polygons and RLE, one folder a split."""
    for split, segmentation in {
        "train": [[10, 20, 40, 20, 40, 25, 40, 30, 10, 30]],
        "valid": {"size": [60, 80], "counts": [20, 2, 60 * 80 - 22]},
    }.items():
        (folder / split).mkdir(parents=True)
        write_png(folder / split / "a_jpg.rf.1.png", np.zeros((60, 80, 3), np.uint8))
        data = {
            "categories": [
                {"id": 0, "name": "veg", "supercategory": "none"},
                {"id": 1, "name": "cucumber", "supercategory": "veg"},
            ],
            "images": [{"id": 0, "file_name": "a_jpg.rf.1.png", "width": 80, "height": 60}],
            "annotations": [
                {
                    "id": 0,
                    "image_id": 0,
                    "category_id": 1,
                    "bbox": [10, 20, 30, 10],
                    "area": 300,
                    "segmentation": segmentation,
                    "iscrowd": 0,
                }
            ],
        }
        (folder / split / "_annotations.coco.json").write_text(json.dumps(data))


def test_roboflow_export(tmp_path: Path) -> None:
    roboflow(tmp_path)
    dataset = read_coco(tmp_path)
    assert dataset.refused == ()
    assert dataset.categories == ("cucumber",)
    assert [(p.file, p.split) for p in dataset.pictures] == [
        ("train/a_jpg.rf.1.png", "train"),
        ("valid/a_jpg.rf.1.png", "val"),
    ]
    label, other = (p.labels[0] for p in dataset.pictures)
    assert label.box.tolist() == [9.5, 19.5, 39.5, 29.5]
    wanted = np.zeros((60, 80), bool)
    wanted[20:30, 10:40] = True
    assert label.mask is not None
    assert other.mask is not None
    assert (label.mask == wanted).all()
    assert np.argwhere(other.mask).tolist() == [[20, 0], [21, 0]]
    # Written as a hub set, the two pictures of one name stay two.
    back = read_coco(write_coco(dataset, tmp_path / "hub").folder)
    assert [p.file for p in back.pictures] == [
        "images/a_jpg.rf.1.png",
        "images/valid_a_jpg.rf.1.png",
    ]


def test_what_names_no_picture_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    images = [{"id": 1, "file_name": "a.png"}]
    lost = [{"image_id": 5}, {}]
    file.write_text(json.dumps({"images": images, "annotations": lost, "categories": []}))
    dataset = read_coco(file)
    assert dataset.pictures == ()
    assert sorted(e.message for e in dataset.refused) == [
        "annotation 1 names no picture",
        "image 1: key 'width' is missing",
        "image 5: has 1 annotations but is not listed",
    ]
    with pytest.raises(DataSetError, match="holds neither"):
        read_coco(tmp_path)
    file.write_text("[]")
    with pytest.raises(DataSetError, match="no list of images"):
        read_coco(file)


def test_crowds_are_ignored_and_ignored_are_crowds(tmp_path: Path, make_set: MakeSet) -> None:
    dataset = make_set("train")
    picture = dataset.pictures[0]
    region = Label(np.array([9.5, 9.5, 29.5, 29.5]), ignore=True)
    write_coco(
        DataSet(dataset.folder, (LabelledPicture(picture.file, 160, 120, (region,)),)),
        dataset.folder,
    )
    data = json.loads((dataset.folder / "annotations.json").read_text())
    assert data["annotations"][0]["iscrowd"] == 1
    assert read_coco(dataset.folder).pictures[0].labels[0].ignore
