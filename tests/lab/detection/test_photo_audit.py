import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.errors import DataSetError
from cucumbervision_lab.detection.photo_audit import (
    Audit,
    AuditedBox,
    AuditedPhoto,
    Kind,
    audited,
    load_audit,
)

SIDES = {
    None,
    *("left", "right", "up", "down"),
    *("up-left", "up-right", "down-left", "down-right"),
}


def write_picture(path: Path, grey: int) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((48, 64, 3), grey, np.uint8))
    return hashlib.sha1(path.read_bytes()).hexdigest()[:12]


def photo(name: str, sha1: str, split: str, *boxes: AuditedBox) -> AuditedPhoto:
    return AuditedPhoto(name, sha1, "some", "scene-" + name, "board", split, 64, 48, boxes)


def audit_of(*photos: AuditedPhoto) -> Audit:
    return Audit(photos, {"some": "us"}, {"some": "CC0"})


def test_no_scene_is_in_two_splits_and_no_photo_is_listed_twice() -> None:
    photos = load_audit().photos
    splits: dict[str, set[str]] = {}
    for p in photos:
        splits.setdefault(p.scene, set()).add(p.split)
    assert [scene for scene, found in splits.items() if len(found) > 1] == []
    assert {p.split for p in photos} == {"train", "test"}
    assert len({p.sha1 for p in photos}) == len(photos)


def test_boxes_lie_in_their_pictures_and_only_whole_fruit_has_a_stem() -> None:
    for p in load_audit().photos:
        for b in p.boxes:
            x1, y1, x2, y2 = b.box
            assert -0.5 <= x1 < x2 <= p.width - 0.5, p.name
            assert -0.5 <= y1 < y2 <= p.height - 0.5, p.name
            assert b.stem in (SIDES if b.kind is not Kind.IGNORE else {None}), p.name
        assert (p.setting in ("none", "parts")) == (not p.whole), p.name
        assert (p.setting == "none") == (not p.boxes), p.name


def test_the_test_split_is_large_and_varied_enough() -> None:
    test = load_audit().in_split("test")
    assert sum(len(p.whole) for p in test) >= 60
    assert len({p.scene for p in test if p.whole}) >= 20
    assert sum(p.setting == "plant" for p in test) >= 8
    assert sum(not p.boxes for p in test) >= 20


def test_scenes_with_whole_fruit_are_about_two_to_one() -> None:
    audit = load_audit()
    train = {p.scene for p in audit.in_split("train") if p.whole}
    test = {p.scene for p in audit.in_split("test") if p.whole}
    assert 0.6 <= len(train) / (len(train) + len(test)) <= 0.7


def test_a_photo_is_known_by_its_bytes_wherever_it_lies(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "deep" / "renamed.png", 90)
    fruit = AuditedBox((9.5, 4.5, 29.5, 44.5), Kind.ZUCCHINI, "up")
    crate = AuditedBox((29.5, -0.5, 63.5, 47.5), Kind.IGNORE)
    data = audited(tmp_path, audit=audit_of(photo("a.png", sha1, "test", fruit, crate)))

    (picture,) = data.pictures
    assert picture.file == "deep/renamed.png"
    assert (picture.scene, picture.split, picture.source, picture.licence) == (
        "scene-a.png",
        "test",
        "us",
        "CC0",
    )
    found, ignored = picture.labels
    assert found.box.tolist() == [9.5, 4.5, 29.5, 44.5]
    assert (found.ignore, found.cut_off, found.extras) == (
        False,
        False,
        {"kind": "zucchini", "stem": "up"},
    )
    assert (ignored.ignore, ignored.cut_off) == (True, True)
    assert data.refused == ()


def test_half_of_the_picture_ignored_is_no_longer_fully_labelled() -> None:
    half = AuditedBox((-0.5, -0.5, 31.5, 47.5), Kind.IGNORE)
    more = AuditedBox((-0.5, -0.5, 32.5, 47.5), Kind.IGNORE)
    fruit = AuditedBox((-0.5, -0.5, 63.5, 47.5), Kind.CUCUMBER)
    assert half.area_px == 32 * 48
    assert photo("a", "0", "test", half, fruit).fully_labelled
    assert not photo("a", "0", "test", more).fully_labelled


def test_only_the_split_asked_for_is_given(tmp_path: Path) -> None:
    first, second = (write_picture(tmp_path / f"{n}.png", n) for n in (10, 20))
    audit = audit_of(photo("10.png", first, "train"), photo("20.png", second, "test"))
    data = audited(tmp_path, "test", audit)
    assert [p.file for p in data.pictures] == ["20.png"]
    assert data.refused == ()


def test_missing_changed_and_unknown_files_are_named(tmp_path: Path) -> None:
    here = write_picture(tmp_path / "here.png", 10)
    write_picture(tmp_path / "changed.png", 20)
    write_picture(tmp_path / "new.png", 30)
    write_picture(tmp_path / "elsewhere" / "other.png", 40)
    audit = audit_of(
        photo("here.png", here, "test"),
        photo("changed.png", "0" * 12, "test"),
        photo("gone.png", "1" * 12, "test"),
    )
    data = audited(tmp_path, audit=audit)
    assert [p.file for p in data.pictures] == ["here.png"]
    assert [str(e) for e in data.refused] == [
        f"{tmp_path}: 2 of 3 audited photos of some are not here",
        f"{tmp_path / 'changed.png'}: its bytes are not those that were audited; fetch it again",
        f"{tmp_path / 'new.png'}: never audited; it is left out",
    ]


def test_a_folder_without_any_of_them_is_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", 10)
    with pytest.raises(DataSetError, match="none of the audited photos is here"):
        audited(tmp_path)


def test_every_audited_photo_is_in_the_real_folder(shared_data: Path) -> None:
    data = audited(shared_data)
    assert data.refused == ()
    assert len(data.pictures) == len(load_audit().photos)
    for picture in data.pictures:
        image = cv2.imread(str(data.path(picture)))
        assert image is not None
        assert image.shape[:2] == (picture.height, picture.width)
