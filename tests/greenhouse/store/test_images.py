from __future__ import annotations

import errno
import hashlib
import os
import stat
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.errors import DiskFullError, StoredImageError, StoreError
from cucumbervision_greenhouse.store.images import DEPTH_UNIT_M, THUMBNAIL_PX, ImageStore
from cucumbervision_greenhouse.store.repository import open_store


@pytest.fixture
def images(tmp_path: Path) -> ImageStore:
    return ImageStore(tmp_path / "pictures")


COLOR = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


def test_a_picture_is_named_by_its_content_and_comes_back_exactly(images: ImageStore) -> None:
    ref = images.put_color(COLOR)
    path = images.path(ref)
    data = path.read_bytes()
    assert ref == f"{hashlib.sha256(data).hexdigest()}.png"
    assert path.relative_to(images.folder).parts == (ref[:2], ref[2:4], ref)
    np.testing.assert_array_equal(images.read_color(ref), COLOR)
    assert list((images.folder / "writing").iterdir()) == []


@pytest.mark.parametrize(("size", "small"), [((480, 848), (181, 320)), ((20, 10), (20, 10))])
def test_a_thumbnail_keeps_the_shape(
    images: ImageStore, size: tuple[int, int], small: tuple[int, int]
) -> None:
    ref = images.put_thumbnail(np.full((*size, 3), (10, 150, 60), np.uint8))
    picture = images.read_color(ref)
    assert picture.shape == (*small, 3)
    assert max(picture.shape) <= THUMBNAIL_PX
    assert np.abs(picture.astype(int) - (10, 150, 60)).max() <= 3


def test_depth_comes_back_to_half_a_step_and_what_is_no_reading_as_0(images: ImageStore) -> None:
    depth = np.array([[0.1, 0.45454, 4.99996, 6.5535], [0, np.nan, np.inf, 7.0]], np.float32)
    back = images.read_depth(images.put_depth(depth))
    assert back.dtype == np.float32
    np.testing.assert_allclose(back[0], depth[0], atol=0.5 * DEPTH_UNIT_M + 1e-6)
    assert back[1].tolist() == [0, 0, 0, 0]
    stored = cv2.imread(str(next(images.files())), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.dtype == np.uint16
    assert stored.tolist() == [[1000, 4545, 50000, 65535], [0, 0, 0, 0]]


def test_the_same_picture_is_written_once(images: ImageStore) -> None:
    path = images.path(images.put_color(COLOR))
    os.utime(path, (1000.0, 1000.0))
    before = path.stat()
    images.put_color(COLOR)
    after = path.stat()
    assert after.st_ino == before.st_ino
    # Used just now: no check may take it for an orphan of long ago.
    assert after.st_mtime > before.st_mtime + 1000
    assert len(list(images.files())) == 1


def test_a_damaged_picture_is_noticed_and_put_again_beside_it(images: ImageStore) -> None:
    ref = images.put_color(COLOR)
    path = images.path(ref)
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    with pytest.raises(StoredImageError, match="its content does not match its name; copy"):
        images.read_color(ref)
    images.put_color(COLOR)
    np.testing.assert_array_equal(images.read_color(ref), COLOR)
    [damaged] = [p for p in images.files() if p != path]
    assert damaged.read_bytes() == whole[:-100]


def test_a_missing_picture_is_named(images: ImageStore) -> None:
    with pytest.raises(StoredImageError, match=r"ab{3}\.png: cannot be read"):
        images.read("abbb.png")


def test_what_is_no_picture_is_said(images: ImageStore) -> None:
    ref = images.put(b"no picture", ".png")
    with pytest.raises(StoredImageError, match="is not a readable picture"):
        images.read_color(ref)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "pictures").write_text("a file")
    with pytest.raises(StoreError, match=r"cannot be written .* send the stop again"):
        ImageStore(tmp_path / "pictures").put(b"x", ".png")


def test_what_cannot_be_finished_leaves_nothing(
    images: ImageStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(DiskFullError, match=r"No space left on device.*; free some space"):
        images.put(b"x", ".png")
    assert [p for p in images.folder.rglob("*") if p.is_file()] == []


def test_a_name_is_given_only_to_what_is_on_the_disk(
    images: ImageStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The order that outlives a power failure: the content, the name, the folder's entry."""
    done: list[str] = []
    sync, rename = os.fsync, Path.replace

    def fsync(handle: int) -> None:
        is_folder = stat.S_ISDIR(os.fstat(handle).st_mode)
        done.append("folder" if is_folder else "content")
        sync(handle)

    def replace(self: Path, target: Path) -> Path:
        done.append("name")
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", replace)
    images.put(b"first", ".png")
    # The entries of the file, of its two folders, and of the whole folder of pictures.
    assert done == ["content", "name", *["folder"] * 4]
    done.clear()
    images.put(b"first", ".png")
    assert done == []


def test_what_a_killed_run_left_half_written_is_removed_at_the_next_start(tmp_path: Path) -> None:
    program = """
import os, pathlib, sys
from cucumbervision_greenhouse.store.images import ImageStore
os.fsync = lambda _: os.kill(os.getpid(), 9)
ImageStore(pathlib.Path(sys.argv[1])).put(b"half a picture", ".png")
"""
    folder = tmp_path / "house.images"
    killed = subprocess.run([sys.executable, "-c", program, folder], check=False)
    assert killed.returncode == -9
    [left] = [path for path in folder.rglob("*") if path.is_file()]
    open_store(tmp_path / "house.db").close()
    assert left.exists()  # another program may be writing it
    os.utime(left, (1.0, 1.0))
    open_store(tmp_path / "house.db").close()
    assert not left.exists()
