from __future__ import annotations

import errno
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cucumbervision.errors import CaptureError, DataSetError
from cucumbervision_lab.data.labels import flat_names, list_pictures, picture_size, place_file


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
def test_size_of_every_kind(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"a{suffix}"
    cv2.imwrite(str(file), np.zeros((37, 91, 3), np.uint8))
    assert picture_size(file) == (91, 37)
    assert list_pictures(tmp_path) == [file]


def test_a_head_that_promises_too_many_pixels_is_not_believed(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4, 3), np.uint8))
    data = (tmp_path / "a.png").read_bytes()
    large = (100_000).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(data[:16] + large + large + data[24:])
    with pytest.raises(CaptureError, match=r"a\.png: is truncated or damaged"):
        picture_size(tmp_path / "a.png")


def test_what_is_no_picture(tmp_path: Path) -> None:
    for data in (b"", b"text", b"\xff\xd8\xff"):
        (tmp_path / "a.jpg").write_bytes(data)
        with pytest.raises(CaptureError):
            picture_size(tmp_path / "a.jpg")


FILES = [
    f"{place}{n}" for place in ("", "train/", "images/", "x/") for n in ("a.jpg", "A.png", "b.png")
]


@given(st.lists(st.sampled_from(FILES), unique=True))
def test_flat_names_differ_even_without_ending_and_case(files: list[str]) -> None:
    names = flat_names(files)
    assert list(names) == files
    assert len({Path(n).stem.lower() for n in names.values()}) == len(files)
    assert all("/" not in n and Path(n).suffix == Path(f).suffix for f, n in names.items())


def test_placing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "a"
    source.write_bytes(b"1")
    target = tmp_path / "b/c"
    place_file(source, target)
    place_file(source, target)
    assert target.samefile(source)
    place_file(source, source)
    assert source.read_bytes() == b"1"
    with pytest.raises(DataSetError, match="the file is missing"):
        place_file(tmp_path / "none", tmp_path / "d")
    with pytest.raises(DataSetError, match="cannot be written"):
        place_file(source, source / "below")

    def refuse(*_: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr("os.link", refuse)
    other = tmp_path / "other"
    place_file(source, other)
    assert not other.samefile(source)
    assert other.read_bytes() == b"1"
