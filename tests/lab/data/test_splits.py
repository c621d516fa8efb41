from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cucumbervision.capture.pictures import read_color, write_png
from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.checks import check_dataset
from cucumbervision_lab.data.labels import SPLITS, DataSet, Label, LabelledPicture
from cucumbervision_lab.data.splits import find_scenes, parse_shares, split_by_scene
from cucumbervision_lab.data.yolo import read_yolo
from cucumbervision_lab.evaluate.scenes import audited

MakeSet = Callable[..., DataSet]
CLASSES = ("cucumber", "zucchini", "banana", "eggplant", "carrot")

sizes = st.lists(st.integers(1, 30), min_size=8, max_size=60)


def made(scene_sizes: list[int], sources: int = 1) -> DataSet:
    fruit = (Label(np.array([1.0, 1, 9, 9])),)
    pictures = [
        LabelledPicture(
            f"{scene}_{k}.png",
            64,
            48,
            fruit if scene % 3 else (),
            scene=f"s{scene}",
            source=f"source {scene % sources}",
        )
        for scene, size in enumerate(scene_sizes)
        for k in range(size)
    ]
    return DataSet(Path("x"), tuple(pictures))


@settings(deadline=None, max_examples=60)
@given(sizes, st.integers(0, 99))
def test_no_scene_is_parted_and_no_picture_lost(scene_sizes: list[int], seed: int) -> None:
    dataset = made(scene_sizes, 2)
    parted = split_by_scene(dataset, seed=seed)
    assert [p.file for p in parted.pictures] == [p.file for p in dataset.pictures]
    splits: dict[str, set[str]] = {}
    for picture in parted.pictures:
        splits.setdefault(picture.scene, set()).add(picture.split)
    assert all(len(own) == 1 and own < set(SPLITS) for own in splits.values())
    again = split_by_scene(replace(dataset, pictures=dataset.pictures[::-1]), seed=seed)
    assert [p.split for p in again.pictures[::-1]] == [p.split for p in parted.pictures]


def test_shares_are_kept_in_every_source() -> None:
    parted = split_by_scene(made([2, 3, 1, 4] * 50, 4))
    for source in range(4):
        own = [p for p in parted.pictures if p.source == f"source {source}"]
        for split, share in zip(SPLITS, (0.7, 0.15, 0.15), strict=True):
            for with_fruit in (True, False):
                some = [p for p in own if bool(p.labels) is with_fruit]
                part = sum(p.split == split for p in some) / len(some)
                assert part == pytest.approx(share, abs=0.06)


def test_pseudo_labels_never_come_to_test() -> None:
    dataset = made([1] * 40)
    pictures = [
        replace(p, labels=(Label(np.array([1.0, 1, 9, 9]), pseudo=True),)) if k % 2 else p
        for k, p in enumerate(dataset.pictures)
    ]
    parted = split_by_scene(replace(dataset, pictures=tuple(pictures)))
    assert parted.in_split("test")
    assert not any(x.pseudo for p in parted.in_split("test") for x in p.labels)
    everything = tuple(
        replace(p, labels=(Label(np.array([1.0, 1, 9, 9]), pseudo=True),)) for p in pictures
    )
    assert not split_by_scene(replace(dataset, pictures=everything)).in_split("test")


def test_shares_and_scenes_must_make_sense() -> None:
    for shares in ("1:1", "0:0:0", "12:-1:-1"):
        with pytest.raises(DataSetError, match="invalid shares"):
            parse_shares(shares)
    bare = replace(made([1]), pictures=(LabelledPicture("a.png", 64, 48),))
    with pytest.raises(DataSetError, match=r"1 pictures have no scene, first a\.png"):
        split_by_scene(bare)
    no_test = split_by_scene(made([1] * 20), (0.8, 0.2, 0.0))
    assert not no_test.in_split("test")
    assert len(no_test.in_split("val")) == 4


def test_copies_and_exports_of_one_picture_share_a_scene(make_set: MakeSet) -> None:
    dataset = make_set("- - - - -")
    names = ("a", "b", "c_jpg.rf.0a1", "c_jpg.rf.9f2", "e")
    pictures = []
    for picture, name in zip(dataset.pictures, names, strict=True):
        path = dataset.path(picture)
        path.rename(path.with_stem(name))
        pictures.append(replace(picture, file=f"images/{name}.png", scene=""))
    # e is b, moved by a few pixels and a little darker.
    moved = np.roll(read_color(dataset.folder / "images/b.png"), 6, axis=1)
    write_png(dataset.folder / "images/e.png", (moved * 0.97).astype(np.uint8))
    pictures[0] = replace(pictures[0], scene="b")  # a name that is taken
    found = find_scenes(replace(dataset, pictures=tuple(pictures)))
    assert [p.scene for p in found.pictures] == ["b", "b'", "c_jpg.rf.0a1", "c_jpg.rf.0a1", "b'"]


@pytest.mark.realdata
def test_scenes_of_real_photos_against_scenes_told_by_eye(shared_data: Path) -> None:
    """The audit's scenes were told by eye, without knowing of the fingerprints."""
    folder = shared_data / "photos/ingredients_ccby4"
    dataset = read_yolo(folder, CLASSES)
    assert dataset.refused == ()
    assert len(dataset.pictures) == 173
    found = find_scenes(dataset)
    own = {Path(p.file).name: p.scene for p in found.pictures}
    told = {Path(p.file).name: p.scene for p in audited(folder).pictures}
    names = sorted(own.keys() & told.keys())
    assert len(names) == 173
    one = np.array([[own[a] == own[b] for a in names] for b in names])
    eye = np.array([[told[a] == told[b] for a in names] for b in names])
    upper = np.triu(np.ones_like(one), 1)
    kept = (one & eye & upper).sum() / (eye & upper).sum()
    assert kept > 0.9
    assert 30 <= len(set(own.values())) <= 60
    parted = split_by_scene(found)
    assert [len(parted.in_split(split)) for split in SPLITS] == [121, 26, 26]
    assert [f for f in check_dataset(parted) if " the same " in str(f)] == []
    # By file, as tools do it, near-duplicates would be everywhere.
    parts = np.random.default_rng(0).choice(SPLITS, len(dataset.pictures), p=(0.7, 0.15, 0.15))
    by_file = [replace(p, split=str(s)) for p, s in zip(dataset.pictures, parts, strict=True)]
    leaks = check_dataset(replace(dataset, pictures=tuple(by_file)))
    assert len([f for f in leaks if " the same " in str(f)]) > 100
