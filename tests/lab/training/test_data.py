from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.errors import DataSetError, TrainingError
from cucumbervision_lab.training.data import prepare_data, write_data_file

yaml = pytest.importorskip("yaml")


def test_pose_gets_the_tolerances(pose_set: Path, tmp_path: Path) -> None:
    written = prepare_data(pose_set.parent, "pose", tmp_path)
    assert yaml.safe_load(written.read_text()) == {
        "path": str(pose_set.parent),
        "train": "images/train",
        "val": "images/val",
        "names": {0: "cucumber"},
        "kpt_shape": [5, 3],
        "flip_idx": [0, 1, 2, 3, 4],
        "kpt_oks_sigmas": [0.05] * 5,
    }
    card = (tmp_path / "data.md").read_text()
    assert "| not stated | not stated | 8 | 8 | 8 |" in card


def test_the_hubs_form_is_written_as_yolo(seg_set: Path, tmp_path: Path) -> None:
    from cucumbervision_lab.datasets.coco import write_coco
    from cucumbervision_lab.datasets.yolo import read_yolo

    write_coco(read_yolo(seg_set), tmp_path / "hub")
    written = prepare_data(tmp_path / "hub", "seg", tmp_path / "run")
    values = yaml.safe_load(written.read_text())
    labels = Path(values["path"]) / "labels" / "train"
    assert Path(values["path"]) == tmp_path / "run" / "data"
    assert len(list(labels.glob("*.txt"))) == 6


def test_a_test_split_with_boxes_only_is_left_out_and_the_class_keeps_its_name(
    seg_set: Path, tmp_path: Path
) -> None:
    from cucumbervision_lab.datasets.coco import write_coco
    from cucumbervision_lab.datasets.yolo import read_yolo

    read = read_yolo(seg_set)
    boxed = replace(
        read.pictures[-1],
        split="test",
        labels=tuple(replace(label, mask_code=None) for label in read.pictures[-1].labels),
    )
    crop = replace(read, pictures=(*read.pictures[:-1], boxed), categories=("courgette",))
    write_coco(crop, tmp_path / "crop")
    values = yaml.safe_load(prepare_data(tmp_path / "crop", "seg", tmp_path / "run").read_text())
    assert values["names"] == {0: "courgette"}
    assert "test" not in values
    assert len(list((tmp_path / "run" / "data" / "labels").rglob("*.txt"))) == 7


def test_leaks_are_refused_before_training(seg_set: Path, tmp_path: Path) -> None:
    shutil.copytree(seg_set.parent, tmp_path / "set")
    for kind, suffix in (("images", "png"), ("labels", "txt")):
        folder = tmp_path / "set" / kind
        shutil.copy(folder / "val" / f"0.{suffix}", folder / "train" / f"copy.{suffix}")
    with pytest.raises(DataSetError, match="copy"):
        prepare_data(tmp_path / "set", "seg", tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert prepare_data(tmp_path / "set", "seg", tmp_path / "run", check=False).is_file()


def test_labels_beyond_the_picture_are_refused(seg_set: Path, tmp_path: Path) -> None:
    shutil.copytree(seg_set.parent, tmp_path / "set")
    (tmp_path / "set/labels/train/5.txt").write_text("0 0.1 0.1 1.4 0.1 0.5 0.5\n")
    with pytest.raises(DataSetError, match=r"5\.txt"):
        prepare_data(tmp_path / "set", "seg", tmp_path / "run")


@pytest.mark.parametrize(
    ("text", "task", "fault"),
    [
        ("train: a\nnames: [cucumber]\n", "seg", "split val is missing"),
        ("train: a\nval: b\nnames: [cucumber, leaf]\n", "seg", "has 2 classes, expected 1"),
        ("train: a\nval: b\nnames: [cucumber]\n", "pose", r"keypoints of shape None"),
        ("train: a\nval: b\nnames: [cucumber]\nkpt_shape: [17, 3]\n", "pose", r"shape \[17, 3\]"),
        ("- 1\n", "seg", "does not describe a data set"),
        ("a: [", "seg", "is not valid YAML"),
    ],
)
def test_faulty_descriptions_are_named(tmp_path: Path, text: str, task: str, fault: str) -> None:
    path = tmp_path / "data.yaml"
    path.write_text(text)
    with pytest.raises((TrainingError, DataSetError), match=fault):
        write_data_file(path, task, tmp_path / "run")
