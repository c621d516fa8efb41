from __future__ import annotations

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.errors import UploadError
from cucumbervision.intake.file_checks import Kind, check_picture, picture_size, sniff

KINDS = {".png": Kind.PNG, ".jpg": Kind.JPEG, ".tif": Kind.TIFF, ".webp": Kind.WEBP}


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (48, 64), (333, 1001)])
def test_the_size_is_the_one_that_opencv_writes(suffix: str, height: int, width: int) -> None:
    data = cv2.imencode(suffix, np.zeros((height, width, 3), np.uint8))[1].tobytes()
    assert sniff(data[:512]) is KINDS[suffix]
    assert picture_size(io.BytesIO(data), KINDS[suffix]) == (width, height)


def test_webp_of_all_three_kinds() -> None:
    lossless = cv2.imencode(
        ".webp", np.zeros((30, 50, 3), np.uint8), (cv2.IMWRITE_WEBP_QUALITY, 101)
    )
    assert picture_size(io.BytesIO(lossless[1].tobytes()), Kind.WEBP) == (50, 30)
    extended = b"RIFF\0\0\0\0WEBPVP8X" + struct.pack("<I", 10) + bytes(4)
    extended += (49).to_bytes(3, "little") + (29).to_bytes(3, "little")
    assert picture_size(io.BytesIO(extended), Kind.WEBP) == (50, 30)


def test_a_big_endian_tiff() -> None:
    entries = [(256, 3, struct.pack(">HH", 50, 0)), (257, 4, struct.pack(">I", 30))]
    body = b"".join(struct.pack(">HHI", tag, kind, 1) + data for tag, kind, data in entries)
    data = b"MM\0*" + struct.pack(">IH", 8, len(entries)) + body
    assert picture_size(io.BytesIO(data), Kind.TIFF) == (50, 30)


def test_a_huge_picture_is_refused_by_its_head_alone(tmp_path: Path) -> None:
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", 13, b"IHDR", 60_000, 60_000, 8, 2)
    (tmp_path / "a").write_bytes(head)
    with pytest.raises(UploadError, match="60000x60000 pixels, more than 40 million"):
        check_picture(tmp_path / "a", Kind.PNG, 40_000_000, source="a.png")


@pytest.mark.parametrize("kind", KINDS.values())
def test_a_head_that_ends_is_damaged(tmp_path: Path, kind: Kind) -> None:
    data = cv2.imencode(kind.value, np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    (tmp_path / "a").write_bytes(data[:9])
    with pytest.raises(UploadError, match=r"^a\.x: is damaged"):
        check_picture(tmp_path / "a", kind, 10_000, source="a.x")
