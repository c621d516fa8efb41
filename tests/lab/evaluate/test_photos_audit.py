import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.errors import DataSetError
from cucumbervision_lab.evaluate.photos import audited, load_audit

SIDES = {
    None,
    *("left", "right", "up", "down"),
    *("up-left", "up-right", "down-left", "down-right"),
}


def write_picture(path: Path, grey: int) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((48, 64, 3), grey, np.uint8))
    return hashlib.sha1(path.read_bytes()).hexdigest()[:12]


def photo(split: str, *boxes: dict[str, Any]) -> dict[str, Any]:
    place = {"set": "some", "scene": "one", "setting": "board", "source": "us", "licence": "CC0"}
    return {**place, "split": split, "size": [64, 48], "boxes": boxes}


def box(x1: int, y1: int, x2: int, y2: int, kind: str = "cucumber", **more: Any) -> dict[str, Any]:
    return {"box": [x1, y1, x2, y2], "class": kind, **more}


def test_the_packaged_audit_is_sound() -> None:
    photos = load_audit().values()
    splits: dict[str, set[str]] = {}
    for p in photos:
        splits.setdefault(p["scene"], set()).add(p["split"])
        width, height = p["size"]
        for b in p["boxes"]:
            x1, y1, x2, y2 = b["box"]
            assert 0 <= x1 < x2 <= width, p["name"]
            assert 0 <= y1 < y2 <= height, p["name"]
            assert b.get("stem") in (SIDES if b["class"] != "ignore" else {None}), p["name"]
            for u, v in b.get("ends") or ():
                assert x1 <= u <= x2, p["name"]
                assert y1 <= v <= y2, p["name"]
        whole = [b for b in p["boxes"] if b["class"] != "ignore"]
        assert (p["setting"] in ("none", "parts")) == (not whole), p["name"]
        assert (p["setting"] == "none") == (not p["boxes"]), p["name"]
    assert [scene for scene, names in splits.items() if len(names) > 1] == []


def test_a_photo_is_known_by_its_bytes_wherever_it_lies(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "deep" / "renamed.png", 90)
    write_picture(tmp_path / "unknown.png", 30)
    fruit = box(10, 5, 30, 45, "zucchini", stem="up", ends=[[20.5, 44.5], [20.5, 5.5]])
    audit = {sha1: photo("test", fruit, box(30, 0, 64, 48, "ignore")), "0" * 12: photo("test")}
    (picture,) = audited(tmp_path, "test", audit).pictures
    assert (picture.file, picture.split, picture.source) == ("deep/renamed.png", "test", "us")
    zucchini, crate = picture.labels
    assert zucchini.box.tolist() == [9.5, 4.5, 29.5, 44.5]
    assert (zucchini.ignore, zucchini.cut_off) == (False, False)
    ends = [[20.0, 44.0], [20.0, 5.0]]
    assert zucchini.extras == {"kind": "zucchini", "stem": "up", "ends_px": ends}
    assert (crate.ignore, crate.cut_off) == (True, True)
    with pytest.raises(DataSetError, match="contains no audited photo"):
        audited(tmp_path, "train", audit)


def test_an_outline_of_the_audit_becomes_a_mask_inside_its_box(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "a.png", 90)
    outline = [[10, 5, 29, 5, 29, 19, 10, 19], [12, 30, 20, 44]]
    (label,) = (
        audited(tmp_path, audit={sha1: photo("train", box(10, 5, 30, 45, outline=outline))})
        .pictures[0]
        .labels
    )
    assert label.mask is not None
    assert label.pseudo
    assert label.mask[5:20, 10:30].all()
    assert label.mask[37, 16]
    assert label.mask.sum() == 20 * 15 + 15
    outlined = [b for p in load_audit().values() for b in p["boxes"] if b.get("outline")]
    assert len(outlined) > 400
    for b in outlined:
        points = np.concatenate([np.reshape(piece, (-1, 2)) for piece in b["outline"]])
        assert [*points.min(axis=0), *(points.max(axis=0) + 1)] == b["box"]


def test_polygons_beside_the_photos_become_masks_where_they_fit(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "images" / "a.png", 90)
    (tmp_path / "labels_seg").mkdir()
    # A triangle over x 8 to 24 and y 12 to 36 of a picture 64 x 48, and one that fits nothing.
    (tmp_path / "labels_seg" / "a.txt").write_text(
        "0 0.125 0.25 0.375 0.25 0.375 0.75\n0 0.5 0.5 0.6 0.5 0.6 0.6\n", encoding="utf-8"
    )
    audit = {sha1: photo("train", box(8, 12, 24, 36), box(41, 12, 64, 36))}
    first, second = audited(tmp_path, audit=audit, outlines=True).pictures[0].labels
    assert first.mask is not None
    assert first.mask.sum() == pytest.approx(16 * 24 / 2, abs=20)
    assert (first.pseudo, second.mask) == (False, None)
    assert all(x.mask is None for x in audited(tmp_path, audit=audit).pictures[0].labels)


@pytest.mark.realdata
def test_every_audited_photo_is_in_the_real_folder(shared_data: Path) -> None:
    data = audited(shared_data, outlines=True)
    assert len(data.pictures) == len(load_audit())
    board = [p for p in data.pictures if p.extras["collection"] == "board_cm"]
    labels = [label for p in board for label in p.labels]
    assert sum(label.mask is not None for label in labels) / len(labels) > 0.9
