from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.capture.pictures import read_color, write_png
from cucumbervision.errors import CucumberVisionError, DataSetError
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision_lab.data.checks import check_dataset, open_dataset, require_clean
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label
from cucumbervision_lab.data.yolo import write_yolo

MakeSet = Callable[..., DataSet]


def faults(findings: Sequence[CucumberVisionError]) -> list[str]:
    return [str(finding.message) for finding in findings]


def with_label(dataset: DataSet, number: int, label: Label) -> DataSet:
    pictures = list(dataset.pictures)
    pictures[number] = replace(pictures[number], labels=(label,))
    return replace(dataset, pictures=tuple(pictures))


def test_a_clean_set_has_no_findings_in_any_form(make_set: MakeSet, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    dataset = make_set()
    assert check_dataset(dataset) == []
    write_coco(dataset, tmp_path / "hub")
    write_yolo(dataset, tmp_path / "seg")
    write_yolo(dataset, tmp_path / "pose", "pose")
    seen: list[int] = []
    for form in ("hub", "seg", "pose"):
        found = open_dataset(tmp_path / form)
        findings = check_dataset(found, progress=seen.append)
        assert findings == []
        assert len(found.pictures) == 4
        require_clean(findings, form)
    assert sum(seen) == 12


def test_every_fault_of_a_yolo_set_is_listed(make_set: MakeSet, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    out = tmp_path / "yolo"
    write_yolo(make_set("train train train val val test"), out)
    lines = "0 0.5 0.5 0.2 1.4", "0 0.5 0.5 0 0.1", "0 0.5", "3 0.5 0.5 0.5 0.5"
    (out / "labels/train/000000.txt").write_text("\n".join(lines))
    (out / "labels/val/000003.txt").unlink()
    (out / "images/val/000004.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    yaml = out / "data.yaml"
    yaml.write_text(yaml.read_text().replace("0: cucumber", "0: cucumber, 1: leaf"))
    findings = check_dataset(open_dataset(out))
    assert faults(findings) == [
        "line 1: has numbers outside 0 to 1, which must be shares of width and height",
        "line 2: the box [79.5, 53.5, 79.5, 65.5] has no area inside the picture of 160x120",
        "line 3: is neither box nor polygon",
        "line 4: its category 3 is not listed",
        "the label file is missing",
        "is truncated or damaged",
        "the class 'leaf' has no label",
    ]
    assert findings[0].source == str(out / "labels/train/000000.txt")
    with pytest.raises(DataSetError, match=r"outside 0 to 1.*\(and 6 more\)"):
        require_clean(findings, out)


def test_every_fault_of_a_coco_set_is_listed(make_set: MakeSet) -> None:
    dataset = make_set()
    write_coco(dataset, dataset.folder)
    file = dataset.folder / "annotations.json"
    data = json.loads(file.read_text())
    data["annotations"][1]["bbox"] = [300, 10, 20, 20]
    data["annotations"][2]["keypoints"] = [1, 2]
    del data["annotations"][2]["keypoints_px"]
    data["annotations"][3]["category_id"] = 7
    data["annotations"][4]["pseudo"] = True
    data["annotations"][5]["pseudo"] = True
    file.write_text(json.dumps(data))
    (dataset.folder / "images/000002.png").unlink()
    write_png(dataset.folder / "images/000003.png", np.zeros((60, 80, 3), np.uint8))
    findings = check_dataset(open_dataset(dataset.folder))
    assert faults(findings) == [
        "annotation 2: its box extends beyond the picture of 160x120",
        "annotation 3: has 2 keypoint numbers, not 15",
        "annotation 4: its category 7 is not listed",
        "the file is missing",
        "is 80x60, but its labels are for 160x120",
        "the test split contains a pseudo-label",
    ]


@pytest.mark.parametrize(
    ("label", "fault"),
    [
        (Label(np.array([5.0, 5, 5, 9])), "its box has no area"),
        (Label(np.array([np.nan, 5, 9, 9])), "its box has no area"),
        (Label(np.array([5.0, 5, 163, 9])), "extends beyond the picture of 160x120"),
        (Label(np.array([5.0, 5, 9, 9]), category=3), "its category 3 has no name"),
        (Label(np.array([5.0, 5, 9, 9]), mask_code=Rle(9, 9, "0")), "has a mask of 9x9"),
        (
            Label(np.array([5.0, 5, 9, 9]), keypoints=np.full((5, 3), 300.0)),
            "a labelled keypoint lies outside the picture",
        ),
        (Label(np.array([5.0, 5, 9, 9]), keypoints=np.zeros((4, 3))), "not 5 x 3 finite numbers"),
    ],
)
def test_a_label_at_fault(make_set: MakeSet, label: Label, fault: str) -> None:
    findings = check_dataset(with_label(make_set(), 1, label), duplicates=False)
    assert [f.source for f in findings] == ["images/000001.png, label 1"]
    assert fault in str(findings[0])


def test_a_scene_in_two_splits_is_told_once_a_split(make_set: MakeSet) -> None:
    dataset = make_set("train train val val test")
    pictures = [replace(p, scene="bench") for p in dataset.pictures]
    findings = check_dataset(replace(dataset, pictures=tuple(pictures)), duplicates=False)
    assert len(findings) == 2
    assert str(findings[0]) == (
        "images/000002.png: scene 'bench' is in val, and with images/000000.png in train; "
        "split by scene: cucumbervision data split"
    )


@pytest.mark.parametrize("change", ["jpeg", "turned", "mirrored", "smaller"])
def test_a_copy_in_another_split_is_found(make_set: MakeSet, change: str) -> None:
    dataset = make_set("train train train val")
    color = read_color(dataset.path(dataset.pictures[1]))
    file = dataset.folder / "images/000003.png"
    changes: dict[str, Any] = {
        "jpeg": cv2.imdecode(
            cv2.imencode(".jpg", color, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_COLOR
        ),
        "turned": cv2.rotate(color, cv2.ROTATE_90_CLOCKWISE),
        "mirrored": color[:, ::-1],
        "smaller": cv2.resize(color, (96, 72), interpolation=cv2.INTER_AREA),
    }
    changed = np.asarray(changes[change])
    write_png(file, np.ascontiguousarray(changed))
    height, width = changed.shape[:2]
    pictures = list(dataset.pictures)
    pictures[3] = replace(pictures[3], width=width, height=height, labels=())
    findings = check_dataset(replace(dataset, pictures=tuple(pictures)))
    assert faults(findings) == ["in val is the same picture as images/000001.png in train"]
    assert check_dataset(replace(dataset, pictures=tuple(pictures)), duplicates=False) == []


def test_splits_must_be_there_and_known(make_set: MakeSet) -> None:
    only = check_dataset(make_set("train train", name="a"), duplicates=False)
    assert faults(only) == ["no picture is in val"]
    odd = check_dataset(make_set("train val dev", name="b"), duplicates=False)
    assert faults(odd) == ["unknown split 'dev'"]
    assert check_dataset(make_set("- -", name="c")) == []


def test_what_is_no_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataSetError, match="folder not found"):
        open_dataset(tmp_path / "none")
