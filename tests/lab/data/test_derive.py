from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_color, write_png
from cucumbervision.errors import DataSetError
from cucumbervision.fruit.mask_codes import encode_rle
from cucumbervision.networks.find import NetworkSegmenter, open_segmenter
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    FruitRow,
    Round,
    StopRecord,
    Verdict,
    key_of,
    new_key,
)
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_lab.cli.data import app
from cucumbervision_lab.data.checks import check_dataset, open_dataset
from cucumbervision_lab.data.coco import read_coco
from cucumbervision_lab.data.derive import (
    add_pseudo_masks,
    convert_dataset,
    dataset_from_store,
    merge_datasets,
    parse_keep,
)
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


WIDTH, HEIGHT = 64, 48
WALK, LATER = key_of("walk"), key_of("later")


def mask_at(left: int, width: int = 8) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[10:30, left : left + width] = True
    return mask


def find(number: int, left: int) -> FruitRow:
    mask = encode_rle(mask_at(left))
    return FruitRow(number, box_x2_px=60.0, box_y2_px=40.0, mask=mask)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path / "house.db") as opened:
        for key in (WALK, LATER):
            opened.save_round(Round(key, house="north"))
        yield opened


def save(store: Store, metre: float, round_key: str = WALK, *, pictures: bool = True) -> list[str]:
    """A stop with one capture of three finds; return their keys."""
    color = np.random.default_rng(int(10 * metre)).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    camera = CameraModel.of(Intrinsics(WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0))
    capture = CaptureRecord(
        "a",
        width_px=WIDTH,
        height_px=HEIGHT,
        camera=camera.model_dump(mode="json"),
        depth_unit_m=0.0001,
        color=store.images.put_color(color) if pictures else None,
        depth=store.images.put_depth(np.full((HEIGHT, WIDTH), 0.5, np.float32)),
        fruit=tuple(find(k, 12 * k) for k in (1, 2, 3)),
    )
    stop = StopRecord(
        "1", key=new_key(), round_key=round_key, position_m=metre, captures=(capture,)
    )
    store.save_stop(stop)
    return [
        detection.key for detection in store.detections(round_key) if detection.stop_key == stop.key
    ]


def test_what_people_said_of_finds_becomes_labels(store: Store, tmp_path: Path) -> None:
    accepted, corrected, rejected = save(store, 0.2)
    save(store, 5.0)  # nobody looked at
    stop = store.detection(accepted).stop.key
    store.set_verdict([accepted], Verdict.ACCEPTED)
    store.set_verdict([rejected], Verdict.REJECTED)
    drawn = mask_at(22, width=12)
    store.correct(corrected, FruitRow(2, mask=encode_rle(drawn), flags="cut-by-frame"))
    store.add_fruit(stop, "a", FruitRow(1, mask=encode_rle(mask_at(50))))
    _, judged, _ = dataset_from_store(store, tmp_path / "set", licence="CC0-1.0")
    assert list(judged.values()) == [Counter(accepted=1, corrected=1, added=1, rejected=1)]
    (picture,) = read_coco(tmp_path / "set").pictures
    masks = [label.mask for label in picture.labels]
    for mask, true in zip(masks, (mask_at(12), drawn, mask_at(50)), strict=True):
        assert mask is not None
        assert (mask == true).all()
    assert picture.labels[0].box.tolist() == [11.5, 9.5, 19.5, 29.5]  # the mask's, not the find's
    assert [label.cut_off for label in picture.labels] == [False, True, False]
    assert not any(label.ignore or label.pseudo for label in picture.labels)
    assert (picture.source, picture.licence, picture.scene) == (
        "north",
        "CC0-1.0",
        '["north", "1", 0.0]',
    )
    color = store.stop(stop).captures[0].color
    assert color is not None
    kept = read_color(tmp_path / "set" / picture.file)
    assert (kept == store.images.read_color(color)).all()
    assert (tmp_path / "set" / str(picture.depth_file)).is_file()
    assert picture.camera == Intrinsics(WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0)
    assert picture.licence == "CC0-1.0"


def test_what_nobody_judged_is_to_be_ignored_and_what_is_taken_back_is_forgotten(
    store: Store, tmp_path: Path
) -> None:
    first, *_ = save(store, 0.2)
    store.set_verdict([first], Verdict.REJECTED)
    stop = store.detection(first).stop.key
    store.add_fruit(stop, "a", FruitRow(1, mask=encode_rle(mask_at(50))))
    store.undo(WALK)
    dataset, judged, _ = dataset_from_store(store, tmp_path / "set")
    assert [label.ignore for label in dataset.pictures[0].labels] == [True, True]
    assert list(judged.values()) == [Counter(rejected=1, unjudged=2)]
    store.undo(WALK)
    with pytest.raises(DataSetError, match="has been reviewed"):
        dataset_from_store(store, tmp_path / "other")


def test_places_keep_their_split_however_the_set_grows(store: Store, tmp_path: Path) -> None:
    for metre in range(12):
        store.set_verdict(save(store, metre + 0.2), Verdict.ACCEPTED)
    before = dataset_from_store(store, tmp_path / "before")[0]
    for metre in range(24):  # another day, a little further on
        store.set_verdict(save(store, metre + 0.7, LATER), Verdict.ACCEPTED)
    after = dataset_from_store(store, tmp_path / "after")[0]
    was, now = ({p.scene: p.split for p in d.pictures} for d in (before, after))
    assert len(now) == 24
    assert {scene: now[scene] for scene in was} == was
    assert set(now.values()) == {"train", "val", "test"}
    assert len(after.pictures) == 36
    assert check_dataset(open_dataset(tmp_path / "after"), duplicates=False) == []


def test_the_command_shows_what_was_judged(store: Store, tmp_path: Path) -> None:
    store.set_verdict(save(store, 0.2), Verdict.ACCEPTED)
    store.set_verdict(save(store, 3.2, pictures=False), Verdict.ACCEPTED)
    words = ["from-store", str(tmp_path / "house.db"), str(tmp_path / "set")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "1 reviewed captures skipped: their pictures were not kept" in result.output
    assert len(read_coco(tmp_path / "set").pictures) == 1


BOX = np.array([29.5, 39.5, 129.5, 79.5])


@pytest.fixture(scope="module")
def segmenter() -> NetworkSegmenter:
    return open_segmenter("mobile-sam", full_precision=True)


def boxed(make_set: MakeSet) -> DataSet:
    """Two pictures of a green bar on brown, with its box and another where nothing is."""
    dataset = make_set("train test")
    color = np.full((120, 160, 3), (120, 80, 50), np.uint8)
    color[40:80, 30:130] = (40, 140, 50)
    pictures = []
    for picture in dataset.pictures:
        write_png(dataset.path(picture), color)
        labels = (Label(BOX), Label(np.array([5.0, 5, 25, 20]), ignore=True), picture.labels[0])
        pictures.append(replace(picture, labels=labels))
    return replace(dataset, pictures=tuple(pictures))


def test_boxes_get_masks_in_train_only(make_set: MakeSet, segmenter: NetworkSegmenter) -> None:
    dataset = boxed(make_set)
    seen: list[int] = []
    drawn, refused = add_pseudo_masks(dataset, segmenter, progress=seen.append)
    assert (refused, seen) == ([], [1, 1])
    train, test = drawn.pictures
    mask = train.labels[0].mask
    assert mask is not None
    wanted = np.zeros((120, 160), bool)
    wanted[40:80, 30:130] = True
    assert (mask & wanted).sum() / (mask | wanted).sum() > 0.95
    assert train.labels[0].pseudo
    assert train.labels[0].box.tolist() == BOX.tolist()
    # What is to be ignored and what has a mask stay as they are.
    assert train.labels[1:] == dataset.pictures[0].labels[1:]
    assert test is dataset.pictures[1]
    (finding,) = check_dataset(drawn, duplicates=False)
    assert "no picture is in val" in str(finding)


def test_a_mask_that_does_not_fit_is_to_be_ignored(
    make_set: MakeSet, segmenter: NetworkSegmenter
) -> None:
    dataset = boxed(make_set)
    picture = dataset.pictures[0]
    small = Label(np.array([60.0, 55.0, 66.0, 60.0]))
    drawn, refused = add_pseudo_masks(
        replace(dataset, pictures=(replace(picture, labels=(small,)),)), segmenter
    )
    ((file, fault),) = refused
    assert file == picture.file
    assert fault in {"mask-empty", "mask-small", "mask-off-box"}
    label = drawn.pictures[0].labels[0]
    assert (label.ignore, label.pseudo, label.mask_code) == (True, False, None)
