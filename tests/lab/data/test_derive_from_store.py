from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision.fruit.mask_codes import encode_rle
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
from cucumbervision_lab.data.derive import dataset_from_store

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
