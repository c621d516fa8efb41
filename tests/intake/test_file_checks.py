from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.errors import UploadError
from cucumbervision.intake.file_checks import FileKind, check_picture, file_kind, picture_size

KINDS = {".png": FileKind.PNG, ".jpg": FileKind.JPEG, ".tif": FileKind.TIFF}


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (48, 64), (333, 1001)])
def test_the_size_is_the_one_that_opencv_writes(suffix: str, height: int, width: int) -> None:
    data = cv2.imencode(suffix, np.zeros((height, width, 3), np.uint8))[1].tobytes()
    assert file_kind(data[:512]) is KINDS[suffix]
    assert picture_size(io.BytesIO(data), KINDS[suffix]) == (width, height)


def test_depth_of_any_type_has_a_size() -> None:
    for dtype in (np.uint16, np.float32, np.float64):
        data = cv2.imencode(".tif", np.zeros((30, 50), dtype))[1].tobytes()
        assert picture_size(io.BytesIO(data), FileKind.TIFF) == (50, 30)


def test_a_big_endian_tiff() -> None:
    entries = [(256, 3, struct.pack(">HH", 50, 0)), (257, 4, struct.pack(">I", 30))]
    body = b"".join(struct.pack(">HHI", tag, kind, 1) + data for tag, kind, data in entries)
    data = b"MM\0*" + struct.pack(">IH", 8, len(entries)) + body
    assert picture_size(io.BytesIO(data), FileKind.TIFF) == (50, 30)


@pytest.mark.parametrize(
    ("tag", "value"),
    [(256, 0), (256, 70_000), (258, 128), (277, 5), (322, 60_000), (323, 60_000)],
)
def test_a_tiff_whose_decoder_would_take_much_memory_is_damaged(
    tmp_path: Path, tag: int, value: int
) -> None:
    entries = {256: 50, 257: 30} | {tag: value}
    body = b"".join(struct.pack("<HHII", *(k, 4, 1, v)) for k, v in sorted(entries.items()))
    (tmp_path / "a").write_bytes(b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4))
    with pytest.raises(UploadError, match=r"^a\.tif: is damaged"):
        check_picture(tmp_path / "a", FileKind.TIFF, 10_000, source="a.tif")


def test_a_huge_picture_is_refused_by_its_head_alone(tmp_path: Path) -> None:
    data = bytearray(cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes())
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    (tmp_path / "a").write_bytes(data)
    with pytest.raises(UploadError, match="60000x60000 pixels, more than 40 million"):
        check_picture(tmp_path / "a", FileKind.PNG, 40_000_000, source="a.png")


@pytest.mark.parametrize("kind", KINDS.values())
def test_a_head_that_ends_is_damaged(tmp_path: Path, kind: FileKind) -> None:
    data = cv2.imencode(kind.value, np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    (tmp_path / "a").write_bytes(data[:9])
    with pytest.raises(UploadError, match=r"^a\.x: is damaged"):
        check_picture(tmp_path / "a", kind, 10_000, source="a.x")
