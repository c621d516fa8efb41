from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.pictures import read_photo
from cucumbervision.errors import CaptureError

GREEN, GREY = (40, 160, 60), 114


def picture() -> NDArray[np.uint8]:
    """40 wide and 24 high: a green field, its upper left quarter red."""
    image = np.full((24, 40, 3), GREEN, np.uint8)
    image[:12, :20] = (200, 30, 20)
    return image


def write(path: Path, image: NDArray[Any]) -> Path:
    if image.ndim == 3 and image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    ok, data = cv2.imencode(path.suffix, image)
    assert ok
    path.write_bytes(data.tobytes())
    return path


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    """Put an EXIF segment with one entry, the orientation (tag 0x112), behind the first marker."""
    entry = struct.pack("<HHIHH", 0x112, 3, 1, orientation, 0)
    tiff = b"II*\x00" + struct.pack("<I", 8) + struct.pack("<H", 1) + entry + struct.pack("<I", 0)
    body = b"Exif\x00\x00" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".tif", ".jpg", ".webp"])
def test_colours_are_rgb(tmp_path: Path, suffix: str) -> None:
    read = read_photo(write(tmp_path / f"a{suffix}", picture()))
    assert read.dtype == np.uint8
    assert np.abs(read[20, 35].astype(int) - GREEN).max() < 12
    assert np.abs(read[4, 5].astype(int) - (200, 30, 20)).max() < 12


@pytest.mark.parametrize(
    ("orientation", "red"), [(1, (4, 5)), (3, (19, 34)), (6, (5, 19)), (8, (34, 4))]
)
def test_exif_turns_the_picture(tmp_path: Path, orientation: int, red: tuple[int, int]) -> None:
    path = write(tmp_path / "a.jpg", picture())
    path.write_bytes(with_orientation(path.read_bytes(), orientation))
    read = read_photo(path)
    # 6 and 8 lie on a side (CIPA DC-008, 4.6.4).
    assert read.shape == ((24, 40, 3) if orientation in (1, 3) else (40, 24, 3))
    assert read[red][0] > 150
    assert sum(read[v, u][0] > 150 for v in (5, -6) for u in (5, -6)) == 1


def test_sixteen_bits_grey_and_both(tmp_path: Path) -> None:
    deep = write(tmp_path / "deep.png", picture().astype(np.uint16) * 257)
    assert np.array_equal(read_photo(deep), picture())
    grey = np.linspace(0, 255, 40).astype(np.uint8)[None].repeat(24, axis=0)
    for image in (grey, grey.astype(np.uint16) * 257):
        read = read_photo(write(tmp_path / "grey.png", image))
        assert np.array_equal(read, grey[..., None].repeat(3, axis=2))


@pytest.mark.parametrize("levels", [np.uint8, np.uint16])
def test_what_is_transparent_lies_on_grey(tmp_path: Path, levels: type) -> None:
    scale = 257 if levels is np.uint16 else 1
    alpha = np.full((24, 40), 255, np.uint8)
    alpha[:, 20:] = 0
    bgra = np.dstack([picture()[..., ::-1], alpha]).astype(levels) * levels(scale)
    read = read_photo(write(tmp_path / "a.png", bgra))
    assert np.array_equal(read[:, :20], picture()[:, :20])
    assert (read[:, 20:] == GREY).all()


def test_what_is_no_picture_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.jpg").write_text("hello")
    (tmp_path / "cut.png").write_bytes(write(tmp_path / "a.png", picture()).read_bytes()[:-20])
    (tmp_path / "cut.tiff").write_bytes(write(tmp_path / "a.tiff", picture()).read_bytes()[:90])
    (tmp_path / "empty.webp").write_bytes(b"")
    for name in ("text.jpg", "cut.png", "cut.tiff", "empty.webp", "none.bmp"):
        with pytest.raises(CaptureError, match=name):
            read_photo(tmp_path / name)
    # OpenCV itself keeps quiet about it.
    assert capfd.readouterr().err == ""


def test_floats_have_no_white(tmp_path: Path) -> None:
    image = picture().astype(np.float32)
    with pytest.raises(CaptureError, match=r"float32.*8 or 16 bits"):
        read_photo(write(tmp_path / "a.tiff", image))
