"""A folder of seeds is as it was, whatever was done to it."""

from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision_lab.robustness.seed_folder import SeedFolder

WHOLE = {"a.txt": b"1", "in/b.txt": b"2", "in/deep/c.db": b"3"}


def _content(folder: Path) -> dict[str, bytes | None]:
    found = sorted(folder.rglob("*"))
    return {p.relative_to(folder).as_posix(): None if p.is_dir() else p.read_bytes() for p in found}


@pytest.fixture
def folder(tmp_path: Path) -> SeedFolder:
    empty = SeedFolder(str(tmp_path), WHOLE)
    empty.restore(everything=True)
    return SeedFolder.of(tmp_path)


def test_a_folder_is_taken_and_written_as_it_is(folder: SeedFolder, tmp_path: Path) -> None:
    assert folder.files == WHOLE
    assert _content(tmp_path) == {**WHOLE, "in": None, "in/deep": None}


def test_strange_files_and_folders_go(folder: SeedFolder, tmp_path: Path) -> None:
    whole = _content(tmp_path)
    (tmp_path / "in" / "deep" / "c.db-wal").write_bytes(b"x")
    (tmp_path / "new" / "er").mkdir(parents=True)
    (tmp_path / "new" / "er" / "x.txt").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "in")
    folder.restore()
    assert _content(tmp_path) == whole


def test_a_reader_may_remove_a_file_and_write_to_a_database(
    folder: SeedFolder, tmp_path: Path
) -> None:
    whole = _content(tmp_path)
    (tmp_path / "a.txt").unlink()
    (tmp_path / "in" / "deep" / "c.db").write_bytes(b"written by its reader")
    folder.restore()
    assert _content(tmp_path) == whole


def test_the_damaged_file_is_written_again_be_it_a_folder(
    folder: SeedFolder, tmp_path: Path
) -> None:
    whole = _content(tmp_path)
    (tmp_path / "in" / "b.txt").unlink()
    (tmp_path / "in" / "b.txt").mkdir()
    folder.restore("in/b.txt")
    (tmp_path / "a.txt").write_bytes(b"damaged")
    folder.restore("a.txt")
    assert _content(tmp_path) == whole


def test_all_is_written_again_after_a_crash(folder: SeedFolder, tmp_path: Path) -> None:
    whole = _content(tmp_path)
    (tmp_path / "a.txt").write_bytes(b"damaged, and nobody says which")
    folder.restore(everything=True)
    assert _content(tmp_path) == whole
