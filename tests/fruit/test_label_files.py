from __future__ import annotations

import json
from pathlib import Path

import pytest

from cucumbervision.errors import InstancesError
from cucumbervision.fruit.label_files import LabelledInstance, read_labels


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("a.json", "{", "is not JSON"),
        ("a.json", "{}", "no annotations"),
        ("a.json", '[{"bbox": [0, 0, 1, 1]}]', "names no picture"),
        ("a.csv", "1,2", "unknown kind"),
        ("a.txt", None, "no such file"),
        ("folder", None, "no such file"),
    ],
)
def test_other_files_are_refused(
    tmp_path: Path, name: str, content: str | None, fault: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(InstancesError, match=fault):
        read_labels(path)


def test_entries_of_a_file_are_kept_in_its_own_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    entries = [
        {"file_name": "b.png", "category_id": 4, "bbox": [1, 2, 3, 4], "score": 0.5},
        {"file_name": "b.png", "category_id": 4, "bbox": [1, 2, float("inf"), 4]},
    ]
    path.write_text(json.dumps(entries), encoding="utf-8")
    (picture,) = read_labels(path)
    record, error = picture.records
    assert (picture.name, picture.number, picture.size_px) == ("b.png", None, None)
    assert isinstance(record, LabelledInstance)
    assert (record.where, record.class_name, record.confidence) == ("annotation 0", "4", 0.5)
    assert record.box is not None
    assert record.box.tolist() == [1, 2, 4, 6]  # from the picture's corner
    assert isinstance(error, InstancesError)
    assert "annotation 1: has a number that is not finite" in str(error)


def test_a_folder_of_yolo_files_names_its_pictures(tmp_path: Path) -> None:
    (tmp_path / "labels").mkdir()
    (tmp_path / "classes.txt").write_text("leaf\ncucumber\n", encoding="utf-8")
    (tmp_path / "labels" / "p.txt").write_text(
        "1 0.5 0.5 0.2 0.4 0.9\n\n0 0.5 0.5\n", encoding="utf-8"
    )
    (picture,) = read_labels(tmp_path)
    record, error = picture.records
    assert picture.name == "p.txt"
    assert isinstance(record, LabelledInstance)
    assert (record.class_name, record.confidence, record.normalised) == ("cucumber", 0.9, True)
    assert record.box is not None
    assert record.box.round(9).tolist() == [0.4, 0.3, 0.6, 0.7]
    assert isinstance(error, InstancesError)
    assert "line 3: is neither box nor polygon" in str(error)
