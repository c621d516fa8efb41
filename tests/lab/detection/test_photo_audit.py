import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.errors import DataSetError
from cucumbervision_lab.detection.photo_audit import (
    FIRST,
    OTHER_PLANTS,
    Audit,
    AuditedBox,
    AuditedPhoto,
    AuditKind,
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
    return Audit(photos, {"some": {"source": "us", "licence": "CC0"}})


def test_no_scene_is_in_two_splits_and_no_photo_is_listed_twice() -> None:
    photos = load_audit().photos
    splits: dict[str, set[str]] = {}
    for p in photos:
        splits.setdefault(p.scene, set()).add(p.split)
    assert [scene for scene, found in splits.items() if len(found) > 1] == []
    assert {p.split for p in photos} == {"train", "val", "test"}
    assert len({p.sha1 for p in photos}) == len(photos)


def test_boxes_lie_in_their_pictures_and_only_whole_fruit_has_a_stem() -> None:
    for p in load_audit().photos:
        for b in p.boxes:
            x1, y1, x2, y2 = b.box
            assert -0.5 <= x1 < x2 <= p.width - 0.5, p.name
            assert -0.5 <= y1 < y2 <= p.height - 0.5, p.name
            assert b.stem in (SIDES if b.kind is not AuditKind.IGNORE else {None}), p.name
            for u, v in b.ends or ():
                assert x1 <= u <= x2, p.name
                assert y1 <= v <= y2, p.name
        assert (p.setting in ("none", "parts")) == (not p.whole), p.name
        assert (p.setting == "none") == (not p.boxes), p.name


def test_the_test_split_is_large_and_varied_enough() -> None:
    test = load_audit().in_split("test")
    assert sum(len(p.whole) for p in test) >= 60
    assert len({p.scene for p in test if p.whole}) >= 20
    assert sum(p.setting == "plant" for p in test) >= 8
    assert sum(not p.boxes for p in test) >= 20


def test_the_networks_of_before_are_judged_on_what_they_were_judged_on() -> None:
    audit = load_audit()
    first = [p for p in audit.photos if audit.test_of(p) == FIRST]
    assert len(first) == 327
    train = {p.scene for p in first if p.whole and p.split == "train"}
    test = {p.scene for p in first if p.whole and p.split == "test"}
    assert 0.6 <= len(train) / (len(train) + len(test)) <= 0.7


def test_every_test_named_apart_has_enough_in_it() -> None:
    audit = load_audit()
    photos: dict[str, list[AuditedPhoto]] = {}
    for p in audit.in_split("test"):
        photos.setdefault(audit.test_of(p), []).append(p)
    assert set(photos) == {
        *(FIRST, "trial board", "hands and tiles", "on the plant", "market", "loose fruit"),
        *("negatives", OTHER_PLANTS),
    }
    required = {
        name: sum(b.kind is AuditKind.CUCUMBER for p in some for b in p.boxes)
        for name, some in photos.items()
    }
    assert required.pop("negatives") == required.pop(OTHER_PLANTS) == 0
    assert min(required.values()) >= 14
    assert min(len(photos["negatives"]), len(photos[OTHER_PLANTS])) >= 40


def test_about_a_fifth_of_the_second_audit_is_test_and_a_tenth_val() -> None:
    audit = load_audit()
    third = ("greenhouse_phone", "on_plant_web", "cucumber_d435", "greenery")  # for training only
    apart = (FIRST, OTHER_PLANTS)
    second = [
        p for p in audit.photos if audit.test_of(p) not in apart and p.collection not in third
    ]
    shares = {
        split: sum(p.split == split for p in second) / len(second) for split in ("val", "test")
    }
    assert shares == pytest.approx({"val": 0.10, "test": 0.20}, abs=0.03)


def test_a_photo_is_known_by_its_bytes_wherever_it_lies(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "deep" / "renamed.png", 90)
    fruit = AuditedBox((9.5, 4.5, 29.5, 44.5), AuditKind.ZUCCHINI, "up")
    crate = AuditedBox((29.5, -0.5, 63.5, 47.5), AuditKind.IGNORE)
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


def test_ends_count_from_the_first_pixels_centre(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "a.png", 90)
    box = AuditedBox((9.5, 4.5, 29.5, 44.5), AuditKind.CUCUMBER, "up", ((20.0, 44.0), (20.0, 5.0)))
    data = audited(tmp_path, audit=audit_of(photo("a.png", sha1, "train", box)))
    assert data.pictures[0].labels[0].extras["ends_px"] == [[20.0, 44.0], [20.0, 5.0]]
    board = next(p for p in load_audit().photos if p.setting == "trial")
    (_, blossom_v), (_, stem_v) = board.boxes[0].ends or ((0, 0), (0, 0))
    assert blossom_v > stem_v


def test_an_outline_of_the_audit_becomes_a_mask_inside_its_box(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "a.png", 90)
    upper, lower = np.array([[10, 5], [29, 5], [29, 19], [10, 19]]), np.array([[12, 30], [20, 44]])
    box = AuditedBox((9.5, 4.5, 29.5, 44.5), AuditKind.CUCUMBER, outline=(upper, lower))
    data = audited(tmp_path, audit=audit_of(photo("a.png", sha1, "train", box)))
    (label,) = data.pictures[0].labels
    assert label.mask is not None
    assert label.pseudo
    assert label.mask[5:20, 10:30].all()
    assert label.mask[37, 16]
    assert label.mask.sum() == 20 * 15 + 15


def test_every_outline_of_the_package_fills_its_box() -> None:
    boxes = [b for p in load_audit().photos for b in p.boxes if b.outline]
    assert len(boxes) > 400
    for b in boxes:
        points = np.concatenate(b.outline)
        assert (*(points.min(axis=0) - 0.5), *(points.max(axis=0) + 0.5)) == b.box


def test_polygons_beside_the_photos_become_masks_where_they_fit(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "images" / "a.png", 90)
    (tmp_path / "labels_seg").mkdir()
    # A triangle over x 8 to 24 and y 12 to 36 of a picture 64 x 48, and one that fits nothing.
    (tmp_path / "labels_seg" / "a.txt").write_text(
        "0 0.125 0.25 0.375 0.25 0.375 0.75\n0 0.5 0.5 0.6 0.5 0.6 0.6\n", encoding="utf-8"
    )
    fits = AuditedBox((7.5, 11.5, 23.5, 35.5), AuditKind.CUCUMBER)
    box = AuditedBox((40.5, 11.5, 63.5, 35.5), AuditKind.CUCUMBER)
    audit = audit_of(photo("a.png", sha1, "train", fits, box))
    first, second = audited(tmp_path, audit=audit, outlines=True).pictures[0].labels
    assert first.mask is not None
    assert first.mask.sum() == pytest.approx(16 * 24 / 2, abs=20)
    assert first.box.tolist() == list(fits.box)
    assert (first.pseudo, second.mask) == (False, None)
    assert all(x.mask is None for x in audited(tmp_path, audit=audit).pictures[0].labels)


@pytest.mark.parametrize(
    ("collection", "setting", "boxed", "name"),
    [
        ("old", "plant", True, FIRST),
        ("stall", "hand", True, "market"),
        ("stall", "plant", True, "on the plant"),
        ("stall", "none", False, "negatives"),
        ("field", "none", False, OTHER_PLANTS),
        ("web", "white", True, "loose fruit"),
    ],
)
def test_a_photos_test(collection: str, setting: str, boxed: bool, name: str) -> None:
    boxes = (AuditedBox((0, 0, 9, 9), AuditKind.CUCUMBER),) if boxed else ()
    one = AuditedPhoto("a", "0", collection, "s", setting, "test", 64, 48, boxes)
    named = {"old": FIRST, "stall": "market", "field": OTHER_PLANTS}
    sets = {**{place: {"test": test} for place, test in named.items()}, "web": {}}
    assert Audit((one,), sets).test_of(one) == name


def test_half_of_the_picture_ignored_is_no_longer_fully_labelled() -> None:
    half = AuditedBox((-0.5, -0.5, 31.5, 47.5), AuditKind.IGNORE)
    more = AuditedBox((-0.5, -0.5, 32.5, 47.5), AuditKind.IGNORE)
    fruit = AuditedBox((-0.5, -0.5, 63.5, 47.5), AuditKind.CUCUMBER)
    assert half.area_px == 32 * 48
    assert photo("a", "0", "test", half, fruit).fully_labelled
    assert not photo("a", "0", "test", more).fully_labelled


def test_only_the_split_asked_for_is_given(tmp_path: Path) -> None:
    first, second = (write_picture(tmp_path / f"{n}.png", n) for n in (10, 20))
    audit = audit_of(photo("10.png", first, "train"), photo("20.png", second, "test"))
    data = audited(tmp_path, "test", audit)
    assert [p.file for p in data.pictures] == ["20.png"]


def test_missing_changed_and_unknown_files_are_left_out(tmp_path: Path) -> None:
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


def test_a_folder_without_any_of_them_is_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", 10)
    with pytest.raises(DataSetError, match="contains no audited photo"):
        audited(tmp_path)


def test_every_audited_photo_is_in_the_real_folder(shared_data: Path) -> None:
    data = audited(shared_data)
    assert len(data.pictures) == len(load_audit().photos)
    for picture in data.pictures:
        image = cv2.imread(str(data.path(picture)))
        assert image is not None
        assert image.shape[:2] == (picture.height, picture.width)


def test_most_fruit_on_the_real_board_has_its_outline(shared_data: Path) -> None:
    data = audited(shared_data, outlines=True)
    board = [p for p in data.pictures if p.extras["collection"] == "board_cm"]
    labels = [label for p in board for label in p.labels]
    assert sum(label.mask is not None for label in labels) / len(labels) > 0.9
