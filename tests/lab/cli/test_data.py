from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from cucumbervision.capture.pictures import write_png
from cucumbervision.cli.app import app as main_app
from cucumbervision.errors import DataSetError
from cucumbervision_lab.cli.data import app
from cucumbervision_lab.data.coco import read_coco

NAMES = "cucumber,zucchini,banana,eggplant,carrot"


def call(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Twenty pictures with box labels and no data.yaml, a green bar in each."""
    monkeypatch.setenv("COLUMNS", "160")
    folder = tmp_path / "photos"
    for kind in ("images", "labels"):
        (folder / kind).mkdir(parents=True)
    for k in range(20):
        color = np.full((96, 128, 3), (120, 80, 50 + 10 * k), np.uint8)
        color[30:60, 20:100] = (40, 140, 50)
        write_png(folder / f"images/{k:02d}.png", color)
        # Columns 20 to 99 of 128, rows 30 to 59 of 96.
        row = f"{k % 5} 0.46875 0.46875 0.625 0.3125\n"
        (folder / f"labels/{k:02d}.txt").write_text(row)
    return folder


def test_from_boxes_without_yaml_to_ultralytics(photos: Path, tmp_path: Path) -> None:
    hub = tmp_path / "hub"
    result = call("convert", photos, hub, "--names", NAMES, "--keep", "0=cucumber",
                  "--source", "mine", "--licence", "CC BY 4.0")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert result.output.strip() == f"20 pictures, 4 labels in {hub}"
    dataset = read_coco(hub)
    assert dataset.categories == ("cucumber",)
    assert dataset.pictures[0].labels[0].box.tolist() == [19.5, 29.5, 99.5, 59.5]

    result = call("split", hub, "--scene-pattern", r"\d\d", "--shares", "50:10:40")
    assert result.exit_code == 0, result.output
    assert "train │ 10" in result.output
    assert {p.split for p in read_coco(hub).pictures} == {"train", "val", "test"}

    result = call("pseudo", hub)
    assert result.exit_code == 0, result.output
    boxes = [x for p in read_coco(hub).in_split("test") for x in p.labels]
    assert boxes
    assert not any(x.pseudo or x.mask_code for x in boxes)
    labels = [x for p in read_coco(hub).pictures if p.split != "test" for x in p.labels]
    assert f"{len(labels)} masks drawn, 0 did not fit" in result.output
    assert all(x.pseudo and x.mask_code for x in labels)

    refused = call("convert", hub, tmp_path / "seg", "--to", "yolo-seg").exception
    assert isinstance(refused, DataSetError)
    assert "have a box but no mask" in str(refused)
    result = call("convert", hub, tmp_path / "seg", "--to", "yolo-seg", "--splits", "train,val")
    assert result.exit_code == 0, result.output
    assert f"data file for Ultralytics: {tmp_path / 'seg/data.yaml'}" in result.output

    result = call("merge", tmp_path / "all", hub, hub)
    assert result.exit_code == 0, result.output
    assert f"40 pictures of 2 sets are in {tmp_path / 'all'}" in result.output


def test_check_prints_a_table_and_exits_with_1(photos: Path) -> None:
    (photos / "labels/03.txt").unlink()
    (photos / "labels/04.txt").write_text("4 0.5 0.5 2 0.5\n")
    result = call("check", photos, "--names", NAMES)
    assert result.exit_code == 1
    lines = " ".join(result.output.split())
    assert "the label file is missing" in lines
    assert "outside 0 to 1" in lines
    assert "20 pictures, 18 labels, 2 faults." in lines
    # What cannot be used is said wherever a set is read, and the rest goes on.
    converted = call("convert", photos, photos.parent / "hub", "--names", NAMES)
    assert converted.exit_code == 1
    assert "2 invalid entries skipped" in converted.output
    assert len(read_coco(photos.parent / "hub").pictures) == 20


def test_check_of_a_clean_set(photos: Path) -> None:
    result = call("check", photos, "--names", NAMES)
    assert (result.exit_code, result.output) == (0, "20 pictures, 20 labels, no fault.\n")


def test_it_draws_a_set_and_says_what_is_in_it(tmp_path: Path) -> None:
    out = tmp_path / "set"
    words = ["synth", "--out", str(out), "--frames", "3", "--size", "160x96", "--workers", "1"]
    result = CliRunner().invoke(main_app, words)
    assert result.exit_code == 0, result.output
    data = read_coco(out)
    fruit = sum(len(picture.labels) for picture in data.pictures)
    assert f"3 pictures (3 train, 0 val, 0 test) with {fruit} cucumbers" in result.output
    assert len(list((out / "depth").glob("*.png"))) == 3


def test_a_size_that_is_none_is_named(tmp_path: Path) -> None:
    words = ["synth", "--out", str(tmp_path), "--size", "big"]
    result = CliRunner().invoke(main_app, words)
    assert result.exit_code != 0
    assert "--size" in str(result.exception)
