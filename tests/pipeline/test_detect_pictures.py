from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.pipeline.detect import find_pictures


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
    found = find_pictures([folder])
    assert [p.name for p in found.pictures] == ["a.JPEG", "b/1.jpg", "b/2.webp", "c.tiff"]
    assert (found.skipped, found.failures) == (1, ())


def test_a_named_file_is_a_picture_whatever_it_is_called(folder: Path) -> None:
    found = find_pictures([str(folder / "notes.txt")])
    assert [p.name for p in found.pictures] == ["notes.txt"]
    assert found.skipped == 0


def test_patterns_that_the_shell_left_alone(folder: Path) -> None:
    found = find_pictures([f"{folder}/**/*.jpg", f"{folder}/*"])
    # The pattern '*' also names the folder b, and passes over hidden files.
    assert [p.name for p in found.pictures] == ["1.jpg", "a.JPEG", "2.webp", "c.tiff"]
    assert found.skipped == 1


def test_a_file_is_looked_at_once_and_names_differ(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "a.JPEG"
    other.parent.mkdir()
    other.write_bytes(b"x")
    found = find_pictures([folder / "a.JPEG", folder, other])
    names = [p.name for p in found.pictures]
    assert names == ["a.JPEG", "b/1.jpg", "b/2.webp", "c.tiff", other.as_posix()]


def test_results_of_an_earlier_run_are_no_pictures(folder: Path) -> None:
    out = folder / "b"
    assert [p.name for p in find_pictures([folder], out).pictures] == ["a.JPEG", "c.tiff"]
    # Unless they are named.
    assert len(find_pictures([out / "1.jpg"], out).pictures) == 1


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    found = find_pictures([tmp_path / "none.jpg", f"{tmp_path}/*.png"])
    assert found.pictures == ()
    assert [f.message for f in found.failures] == [
        f"{tmp_path}/none.jpg: does not exist; check the path",
        f"{tmp_path}/*.png: no file matches it; check the path",
    ]
