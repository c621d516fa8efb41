from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.run.batch import Item
from cucumbervision.run.detect import find_pictures
from cucumbervision.run.inputs import Listed
from cucumbervision.run.measurer import Failure


def names(items: list[Item]) -> list[str]:
    return [one.name for one in items if isinstance(one, Listed)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (
        "b/2.webp",
        "b/1.jpg",
        "a.JPEG",
        "c.tiff",
        "notes.txt",
        ".hidden.jpg",
        ".git/x.png",
    ):
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    return tmp_path / "photos"


def test_a_folder_gives_its_pictures_by_name_and_counts_the_rest(folder: Path) -> None:
    found, skipped = find_pictures([folder])
    assert names(found) == ["a.JPEG", "b/1.jpg", "b/2.webp", "c.tiff"]
    assert skipped == 1


def test_a_named_file_is_a_picture_whatever_it_is_called(folder: Path) -> None:
    found, skipped = find_pictures([str(folder / "notes.txt")])
    assert (names(found), skipped) == (["notes.txt"], 0)


def test_a_file_is_looked_at_once_and_names_differ(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "a.JPEG"
    other.parent.mkdir()
    other.write_bytes(b"x")
    found, _ = find_pictures([folder / "a.JPEG", folder, other])
    assert names(found) == ["a.JPEG", "b/1.jpg", "b/2.webp", "c.tiff", other.as_posix()]


def test_results_of_an_earlier_run_are_no_pictures(folder: Path) -> None:
    out = folder / "b"
    assert names(find_pictures([folder], out)[0]) == ["a.JPEG", "c.tiff"]
    # Unless they are named.
    assert len(find_pictures([out / "1.jpg"], out)[0]) == 1


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    found, _ = find_pictures([tmp_path / "none.jpg", tmp_path / "empty"])
    assert [one.message for one in found if isinstance(one, Failure)] == [
        f"{tmp_path}/none.jpg: does not exist; check the path",
        f"{tmp_path}/empty: there are no pictures; name JPEG, PNG, WebP, TIFF or BMP files, or a "
        "folder with some",
    ]
