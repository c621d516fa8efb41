import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.evaluate.scenes import audited, load_audit, photo_truth

SIDES = {"left", "right", "up", "down", "up-left", "up-right", "down-left", "down-right"}


def write_picture(path: Path, grey: int) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((48, 64, 3), grey, np.uint8))
    return hashlib.sha1(path.read_bytes()).hexdigest()[:12]


def audit(*photos: LabelledPicture) -> DataSet:
    return DataSet(Path(), photos, ("cucumber", "zucchini"))


def photo(sha1: str, split: str, *labels: Label) -> LabelledPicture:
    return LabelledPicture(sha1, 64, 48, labels, "one", split, "us", "CC0")


def box(x1: int, y1: int, x2: int, y2: int) -> np.ndarray:
    return np.array([x1, y1, x2, y2]) - 0.5


def test_the_packaged_audit_is_sound() -> None:
    data = load_audit()
    assert data.refused == ()
    splits: dict[str, set[str]] = {}
    outlined = 0
    for p in data.pictures:
        splits.setdefault(p.scene, set()).add(p.split)
        for label in p.labels:
            low, high = label.box[:2] + 0.5, label.box[2:] + 0.5
            assert (low >= 0).all(), p.file
            assert (low < high).all(), p.file
            assert (high <= (p.width, p.height)).all(), p.file
            assert label.extras.get("stem") in (SIDES if not label.ignore else set()) | {None}
            for end in () if label.keypoints is None else label.keypoints[[0, 4], :2]:
                assert (label.box[:2] <= end).all(), p.file
                assert (end <= label.box[2:]).all(), p.file
            if label.mask_code is not None:
                assert label.pseudo
                assert p.split != "test"
                outlined += 1
        setting = p.extras["setting"]
        assert (setting in ("none", "parts")) == (not p.shows_fruit), p.file
        assert (setting == "none") == (not p.labels), p.file
    assert [scene for scene, names in splits.items() if len(names) > 1] == []
    assert outlined > 400


def test_a_photo_is_known_by_its_bytes_wherever_it_lies(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "deep" / "renamed.png", 90)
    write_picture(tmp_path / "unknown.png", 30)
    fruit = Label(box(10, 5, 30, 45), category=1)
    crate = Label(box(30, 0, 64, 48), ignore=True)
    book = audit(photo(sha1, "test", fruit, crate), photo("0" * 12, "test"))
    found = audited(tmp_path, "test", book)
    (picture,) = found.pictures
    assert (picture.file, picture.split, picture.source) == ("deep/renamed.png", "test", "us")
    truth = photo_truth(picture, found).true
    assert [(one.optional, one.ignore) for one in truth] == [(True, False), (False, True)]
    with pytest.raises(DataSetError, match="contains no audited photo"):
        audited(tmp_path, "train", book)


def test_polygons_beside_the_photos_become_masks_where_they_fit(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "images" / "a.png", 90)
    (tmp_path / "labels_seg").mkdir()
    # A triangle over x 8 to 24 and y 12 to 36 of a picture 64 x 48, and one that fits nothing.
    (tmp_path / "labels_seg" / "a.txt").write_text(
        "0 0.125 0.25 0.375 0.25 0.375 0.75\n0 0.5 0.5 0.6 0.5 0.6 0.6\n", encoding="utf-8"
    )
    book = audit(photo(sha1, "train", Label(box(8, 12, 24, 36)), Label(box(41, 12, 64, 36))))
    first, second = audited(tmp_path, audit=book, outlines=True).pictures[0].labels
    assert first.mask is not None
    assert first.mask.sum() == pytest.approx(16 * 24 / 2, abs=20)
    assert (first.pseudo, second.mask) == (False, None)
    assert all(x.mask is None for x in audited(tmp_path, audit=book).pictures[0].labels)


@pytest.mark.realdata
def test_every_audited_photo_is_in_the_real_folder(shared_data: Path) -> None:
    data = audited(shared_data, outlines=True)
    assert len(data.pictures) == len(load_audit().pictures)
    board = [p for p in data.pictures if p.extras["collection"] == "board_cm"]
    labels = [label for p in board for label in p.labels]
    assert sum(label.mask is not None for label in labels) / len(labels) > 0.9
