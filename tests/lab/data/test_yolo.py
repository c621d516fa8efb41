from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.pictures import write_png
from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.labels import DataSet, Label, keep_classes
from cucumbervision_lab.data.yolo import read_yolo, write_yolo

MakeSet = Callable[..., DataSet]


def rows(file: Path) -> list[list[float]]:
    return [[float(v) for v in line.split()] for line in file.read_text().splitlines()]


def test_segments_read_back_as_the_same_masks(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set()
    counts, lines = write_yolo(dataset, tmp_path / "yolo")
    assert (counts, lines) == ({"train": 2, "val": 1, "test": 1}, 6)
    back = read_yolo(tmp_path / "yolo")
    assert back.refused == ()
    assert back.categories == ("cucumber",)
    by_name = {Path(p.file).name: p for p in back.pictures}
    for picture in dataset.pictures:
        other = by_name[Path(picture.file).name]
        assert (other.split, other.scene, other.source, other.licence) == (
            picture.split,
            picture.scene,
            picture.source,
            picture.licence,
        )
        for a, b in zip(picture.labels, other.labels, strict=True):
            assert a.mask_code == b.mask_code
            np.testing.assert_allclose(a.box, b.box)


def test_keypoints_read_back(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set()
    write_yolo(dataset, tmp_path / "yolo", "pose")
    text = (tmp_path / "yolo/data.yaml").read_text()
    assert "kpt_shape: [5, 3]" in text
    assert "flip_idx: [0, 1, 2, 3, 4]" in text
    label = dataset.pictures[0].labels[0]
    back = read_yolo(tmp_path / "yolo")
    other = next(p for p in back.pictures if p.file.endswith("000000.png")).labels[0]
    assert label.keypoints is not None
    assert other.keypoints is not None
    np.testing.assert_allclose(other.keypoints[:4], label.keypoints[:4], atol=1e-3)
    # The fifth lies outside the picture.
    assert other.keypoints[4].tolist() == [0, 0, 0]
    np.testing.assert_allclose(other.box, label.box, atol=1e-3)


@pytest.mark.train
@pytest.mark.parametrize("task", ["segment", "pose"])
def test_ultralytics_reads_what_is_written(
    make_set: MakeSet, tmp_path: Path, task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ultralytics")
    monkeypatch.setenv("YOLO_OFFLINE", "1")
    from ultralytics.data.utils import check_det_dataset, verify_image_label

    dataset = make_set()
    write_yolo(dataset, tmp_path / "yolo", task)
    data = check_det_dataset(str(tmp_path / "yolo/data.yaml"), autodownload=False)
    assert data["names"] == {0: "cucumber"}
    image = Path(data["train"]) / "000000.png"
    label = tmp_path / "yolo/labels/train/000000.txt"
    arguments: list[Any] = [str(image), str(label), "", task == "pose", 1, 5, 3, False]
    _file, labels, shape, segments, points, missing, _, empty, corrupt, message = (
        verify_image_label(arguments)
    )
    assert (missing, empty, corrupt, message) == (0, 0, 0, "")
    assert shape == (120, 160)
    # Columns 20 to 64 of 160, rows 40 to 55 of 120, from the corner.
    first = dataset.pictures[0].labels[0]
    size = np.array([160, 120, 160, 120])
    centre, extent = labels[0, 1:3] * size[:2], labels[0, 3:] * size[:2]
    edges = np.concatenate([centre - extent / 2, centre + extent / 2]) - 0.5
    np.testing.assert_allclose(edges, first.box, atol=1e-3)
    if task == "pose":
        assert points.shape == (2, 5, 3)
    else:
        assert len(segments) == 2


def test_what_cannot_be_written_is_refused(make_set: MakeSet, tmp_path: Path) -> None:
    out = tmp_path / "yolo"
    with pytest.raises(DataSetError, match="unknown task 'obb'"):
        write_yolo(make_set(name="a"), out, "obb")
    with pytest.raises(DataSetError, match=r"1 pictures are in no split, first images/000001.png"):
        write_yolo(make_set("train -", name="b"), out)
    dataset = make_set(name="c")
    boxed = replace(dataset.pictures[0], labels=(Label(np.array([1.0, 1, 9, 9])),))
    with pytest.raises(DataSetError, match=r"1 labels have a box but no mask.*data pseudo"):
        write_yolo(replace(dataset, pictures=(boxed,)), out)
    dataset.path(dataset.pictures[0]).unlink()
    with pytest.raises(DataSetError, match="the file is missing"):
        write_yolo(dataset, out)


def export(folder: Path, yaml: str, splits: tuple[str, ...]) -> None:
    """A folder as Roboflow exports it: SPLIT/images and SPLIT/labels."""
    for k, split in enumerate(splits):
        for kind in ("images", "labels"):
            (folder / split / kind).mkdir(parents=True)
        write_png(folder / split / f"images/{k}_jpg.rf.png", np.zeros((60, 80, 3), np.uint8))
        (folder / split / f"labels/{k}_jpg.rf.txt").write_text(
            "0 0.5 0.5 0.5 0.5\n1 0.1 0.1 0.4 0.1 0.4 0.2 0.4 0.4 0.1 0.4\n2 0.5 0.5 0.1 0.1\n"
        )
    (folder / "data.yaml").write_text(yaml)


ROBOFLOW_YAML = """train: ../train/images
val: ../valid/images
test: ../test/images
nc: 3
names: ['cucumber', 'zucchini', 'leaf']
"""


def test_roboflow_export_with_boxes_and_polygons(tmp_path: Path) -> None:
    export(tmp_path / "x", ROBOFLOW_YAML, ("train", "valid", "test"))
    keep = {"cucumber": "cucumber", "1": "cucumber"}
    dataset = keep_classes(read_yolo(tmp_path / "x/data.yaml"), keep)
    assert dataset.refused == ()
    assert dataset.categories == ("cucumber",)
    assert sorted((p.file, p.split) for p in dataset.pictures) == [
        ("test/images/2_jpg.rf.png", "test"),
        ("train/images/0_jpg.rf.png", "train"),
        ("valid/images/1_jpg.rf.png", "val"),
    ]
    box, polygon = dataset.pictures[0].labels
    assert box.box.tolist() == [19.5, 14.5, 59.5, 44.5]
    assert box.mask_code is None
    # 0.1 to 0.4 of 80 columns and 60 rows.
    assert polygon.mask is not None
    wanted = np.zeros((60, 80), bool)
    wanted[6:24, 8:32] = True
    assert (polygon.mask == wanted).all()
    assert (box.category, polygon.category) == (0, 0)


def test_paths_lists_and_names_of_ultralytics(tmp_path: Path) -> None:
    yaml = """path: .
train: [train/images, more.txt]
val: test/images
names:
  0: cucumber
  1: zucchini
  2: leaf
"""
    export(tmp_path / "x", yaml, ("train", "valid", "test"))
    (tmp_path / "x/more.txt").write_text("./valid/images/1_jpg.rf.png\n")
    dataset = read_yolo(tmp_path / "x")
    assert {p.file: p.split for p in dataset.pictures} == {
        "train/images/0_jpg.rf.png": "train",
        "valid/images/1_jpg.rf.png": "train",
        "test/images/2_jpg.rf.png": "val",
    }
    assert dataset.categories == ("cucumber", "zucchini", "leaf")


def test_a_folder_without_yaml_needs_names(tmp_path: Path) -> None:
    export(tmp_path, "", ())
    (tmp_path / "data.yaml").unlink()
    for kind in ("images", "labels"):
        (tmp_path / kind).mkdir()
    write_png(tmp_path / "images/a.png", np.zeros((60, 80, 3), np.uint8))
    (tmp_path / "labels/a.txt").write_text("1 0.5 0.5 0.5 0.5\n")
    with pytest.raises(DataSetError, match=r"add data\.yaml or give --names"):
        read_yolo(tmp_path)
    both = read_yolo(tmp_path, ["cucumber", "zucchini"])
    dataset = keep_classes(both, {"zucchini": "fruit"})
    assert [(p.file, p.split) for p in dataset.pictures] == [("images/a.png", "")]
    assert dataset.categories == ("fruit",)
    (tmp_path / "images/a.png").unlink()
    with pytest.raises(DataSetError, match="contains no pictures"):
        read_yolo(tmp_path, ["cucumber"])


def test_keypoint_rows_must_have_their_length(tmp_path: Path) -> None:
    export(tmp_path, ROBOFLOW_YAML + "kpt_shape: [5, 2]\n", ("train",))
    file = tmp_path / "train/labels/0_jpg.rf.txt"
    good = "0 0.5 0.5 0.5 0.5" + " 0.25 0.5" * 5
    file.write_text(f"{good}\n{good} 0.1\n0 0.5 0.5 0.5 0.5\n")
    dataset = read_yolo(tmp_path)
    assert [e.message for e in dataset.refused] == [
        "line 2: has 16 values, expected 15 (box, 5 keypoints)",
        "line 3: has 5 values, expected 15 (box, 5 keypoints)",
    ]
    keypoints = dataset.pictures[0].labels[0].keypoints
    assert keypoints is not None
    assert keypoints.tolist() == [[19.5, 29.5, 2]] * 5
    (tmp_path / "data.yaml").write_text(ROBOFLOW_YAML + "kpt_shape: [4, 2]\n")
    with pytest.raises(DataSetError, match=r"kpt_shape is \[4, 2\]"):
        read_yolo(tmp_path)


def test_yaml_faults(tmp_path: Path) -> None:
    export(tmp_path, "names: [", ("train",))
    with pytest.raises(DataSetError, match="is damaged"):
        read_yolo(tmp_path)
    (tmp_path / "data.yaml").write_text("names: {0: a, 2: b}\ntrain: train/images")
    with pytest.raises(DataSetError, match="not consecutive from 0"):
        read_yolo(tmp_path)
    (tmp_path / "data.yaml").write_text("just text")
    with pytest.raises(DataSetError, match="does not describe a data set"):
        read_yolo(tmp_path)
