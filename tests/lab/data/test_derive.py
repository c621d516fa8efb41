from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.coco import read_coco
from cucumbervision_lab.data.derive import convert_dataset, merge_datasets, parse_keep
from cucumbervision_lab.data.labels import DataSet, Label, keep_classes

MakeSet = Callable[..., DataSet]


def test_merged_sets_keep_source_split_and_truth(make_set: MakeSet, tmp_path: Path) -> None:
    one = make_set("train test", name="one")
    other = make_set("train val", name="other")
    nameless = replace(other.pictures[1], source="", scene="")
    other = replace(other, pictures=(other.pictures[0], nameless), categories=("zucchini",))
    seen: list[int] = []
    merge_datasets([one, other], tmp_path / "all", progress=seen.append)
    merged = read_coco(tmp_path / "all")
    assert merged.refused == ()
    assert len(seen) == 4
    assert merged.categories == ("cucumber", "zucchini")
    assert [(p.file, p.scene, p.split, p.source) for p in merged.pictures] == [
        ("images/000000.png", "scene-0", "train", "drawn"),
        ("images/000001.png", "scene-1", "test", "drawn"),
        ("images/other_000000.png", "other-2/scene-0", "train", "drawn"),
        ("images/other_000001.png", "", "val", "other"),
    ]
    for picture, origin in zip(merged.pictures, (*one.pictures, *other.pictures), strict=True):
        folder = one.folder if picture.file.count("other") == 0 else other.folder
        assert merged.path(picture).read_bytes() == (folder / origin.file).read_bytes()
        assert picture.depth_file is not None
        assert origin.depth_file is not None
        depth = (merged.folder / picture.depth_file).read_bytes()
        assert depth == (folder / origin.depth_file).read_bytes()
        assert [x.mask_code for x in picture.labels] == [x.mask_code for x in origin.labels]
    assert {x.category for x in merged.pictures[2].labels} == {1}


def test_what_cannot_be_merged(make_set: MakeSet, tmp_path: Path) -> None:
    with pytest.raises(DataSetError, match="nothing to merge"):
        merge_datasets([], tmp_path)
    dataset = make_set()
    with pytest.raises(DataSetError, match="one of the sets to merge"):
        merge_datasets([dataset], dataset.folder)


def test_classes_by_number_or_name(make_set: MakeSet) -> None:
    dataset = make_set("train")
    labels = tuple(Label(np.array([1.0, 1, 9, 9]), category=k) for k in (0, 1, 2))
    pictures = (replace(dataset.pictures[0], labels=labels),)
    named = replace(dataset, pictures=pictures, categories=("leaf", "zucchini", "cucumber"))
    kept = keep_classes(named, parse_keep(["2=cucumber", "zucchini=cucumber"]))
    assert kept.categories == ("cucumber",)
    assert [x.category for x in kept.pictures[0].labels] == [0, 0]
    with pytest.raises(DataSetError, match=r"unknown class 3; use one of leaf"):
        keep_classes(named, {"3": "cucumber"})
    with pytest.raises(DataSetError, match="invalid class mapping"):
        parse_keep(["cucumber"])


def test_conversions_name_what_they_wrote(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set()
    assert convert_dataset(dataset, tmp_path / "a", "coco") == (
        f"4 pictures, 6 labels in {tmp_path / 'a'}"
    )
    line = convert_dataset(dataset, tmp_path / "c", "yolo-seg", splits=("train", "val"))
    assert line.startswith("2 train, 1 val, 0 test, 5 labels")
    assert not (tmp_path / "c/images/test").exists()
    for arguments, fault in (
        ((tmp_path / "d", "voc"), "unknown format 'voc'"),
        ((dataset.folder, "coco"), "is the folder of the input"),
    ):
        with pytest.raises(DataSetError, match=fault):
            convert_dataset(dataset, *arguments)
    with pytest.raises(DataSetError, match="unknown split 'dev'"):
        convert_dataset(dataset, tmp_path / "d", "yolo-seg", splits=("dev",))


def test_source_and_licence_are_given_where_none_is_stated(
    make_set: MakeSet, tmp_path: Path
) -> None:
    dataset = make_set("train val")
    first = replace(dataset.pictures[0], source="", licence="")
    convert_dataset(
        replace(dataset, pictures=(first, dataset.pictures[1])),
        tmp_path / "a",
        "coco",
        source="mine",
        licence="CC BY 4.0",
    )
    assert [(p.source, p.licence) for p in read_coco(tmp_path / "a").pictures] == [
        ("mine", "CC BY 4.0"),
        ("drawn", "CC0-1.0"),
    ]
