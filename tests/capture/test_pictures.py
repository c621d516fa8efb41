from __future__ import annotations

import pickle
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.capture.pictures import (
    read_color,
    read_depth,
    read_masks,
    read_photo,
    write_png,
)
from cucumbervision.errors import CaptureError, DepthError
from cucumbervision.files import read_json

RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (30, 40, 3), dtype=np.uint8)
DEPTH = RNG.integers(0, 9000, (30, 40), dtype=np.uint16)


def test_color_is_rgb(tmp_path: Path) -> None:
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 0] = 255
    write_png(tmp_path / "a.png", red)
    np.testing.assert_array_equal(read_color(tmp_path / "a.png"), red)
    cv2.imwrite(str(tmp_path / "a.jpg"), red[..., ::-1])
    assert read_color(tmp_path / "a.jpg")[4, 4].tolist() == pytest.approx([255, 0, 0], abs=3)


@pytest.mark.parametrize("name", ["d.png", "d.tiff", "d.npy"])
def test_depth_is_read_as_it_is(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "d.npy":
        np.save(path, DEPTH)
    else:
        cv2.imwrite(str(path), DEPTH)
    read = read_depth(path)
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, DEPTH)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tiff"])
@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.97])
def test_truncated_pictures_are_refused(name: str, kept: float, tmp_path: Path) -> None:
    path = tmp_path / name
    cv2.imwrite(str(path), COLOR)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(CaptureError, match=rf"{name}: .*(empty|truncated|not a readable picture)"):
        read_color(path)


def test_a_flipped_bit_in_a_png_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    write_png(path, DEPTH)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="truncated or damaged"):
        read_depth(path)


@pytest.mark.parametrize("reader", [read_color, read_depth, read_json])
def test_missing_files_and_folders(reader: object, tmp_path: Path) -> None:
    assert callable(reader)
    with pytest.raises(CaptureError, match=r"none\.png: the file is missing"):
        reader(tmp_path / "none.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(CaptureError, match=r"folder\.png: cannot be read"):
        reader(tmp_path / "folder.png")
    with pytest.raises(CaptureError, match=r"a.b\.png: cannot be read \(its name holds a null\)"):
        reader(tmp_path / "a\0b.png")


def test_depth_of_another_kind(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"'\.jpg' is not a depth picture"):
        read_depth(tmp_path / "a.jpg")


def test_arrays_by_columns_are_read_as_they_are(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.asfortranarray(DEPTH))
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy"), DEPTH)


def test_python_objects_are_never_loaded(tmp_path: Path) -> None:
    path = tmp_path / "d.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DepthError, match=r"d\.npy: holds no numbers.*numpy\.save"):
        read_depth(path)
    path.write_bytes(pickle.dumps(DEPTH))
    with pytest.raises(DepthError, match="is damaged"):
        read_depth(path)


@pytest.mark.parametrize("kept", [0.01, 0.6, 0.98])
def test_truncated_arrays(kept: float, tmp_path: Path) -> None:
    path = tmp_path / "d.npy"
    np.save(path, DEPTH)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(DepthError, match="is damaged"):
        read_depth(path)


@pytest.mark.parametrize("dtype", ["<U9999999", "S4000", "V2000", [("a", "<f4", 9)]])
def test_items_that_are_no_numbers_are_refused_by_the_head(dtype: Any, tmp_path: Path) -> None:
    # An array of no items takes no room in the file, whatever its items would take in memory.
    with (tmp_path / "d.npy").open("wb") as stream:
        descr = np.lib.format.dtype_to_descr(np.dtype(dtype))
        head = {"descr": descr, "fortran_order": False, "shape": (0, 0)}
        np.lib.format.write_array_header_1_0(stream, head)
    with pytest.raises(DepthError, match="holds no numbers"):
        read_depth(tmp_path / "d.npy")


def test_mask_of_another_size(tmp_path: Path) -> None:
    mask = np.zeros((30, 40), np.uint8)
    mask[3:5, 6] = 1
    write_png(tmp_path / "m.png", mask)
    (read,) = read_masks([tmp_path / "m.png"], (30, 40, 3))
    np.testing.assert_array_equal(read, mask > 0)
    with pytest.raises(CaptureError, match=r"m\.png: the mask is 40x30, the picture 41x30"):
        read_masks([tmp_path / "m.png"], (30, 41))


def test_a_folder_that_is_not_there_cannot_be_written_to(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"a\.png: cannot be written"):
        write_png(tmp_path / "none" / "a.png", COLOR)


def test_a_head_that_promises_gigabytes_makes_no_room(tmp_path: Path) -> None:
    # One bit a pixel: 25 MB that deflate to 24 kB, and would be 600 MB of colour.
    width, height = 20_008, 10_000
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    rows = zlib.compress(bytes((width // 8 + 1) * height))
    chunks = ((b"IHDR", head), (b"IDAT", rows), (b"IEND", b""))
    (tmp_path / "large.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
            for name, body in chunks
        )
    )
    code = (
        "import re, sys, pathlib; from cucumbervision.capture.pictures import read_color\n"
        "try: read_color(pathlib.Path(sys.argv[1]))\n"
        "except Exception as error: print(type(error).__name__)\n"
        # getrusage would tell the parent's peak, too.
        "status = pathlib.Path('/proc/self/status').read_text()\n"
        "print(int(re.search(r'VmHWM:\\s+(\\d+)', status)[1]) // 1024)"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "large.png")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    name, held_mib = done.stdout.split()
    assert name == "CaptureError"
    assert int(held_mib) < 200


@pytest.mark.parametrize("name", ["a.webp", "a.jpg", "a.tif"])
def test_pictures_of_too_many_pixels_are_refused_by_their_heads(name: str, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / name), np.zeros((8001, 8000), np.uint8))
    if name == "a.tif":  # its size said twice, small at first and small at last
        path, data = tmp_path / name, bytearray((tmp_path / name).read_bytes())
        at = int.from_bytes(data[4:8], "little")
        count = int.from_bytes(data[at : at + 2], "little")
        small = [struct.pack("<HHII", tag, 4, 1, 8) for tag in (256, 257)]
        tags = [bytes(data[at + 2 + 12 * k : at + 14 + 12 * k]) for k in range(count)]
        data[4:8] = len(data).to_bytes(4, "little")
        tags = tags[:2] + small + tags[2:]
        data += struct.pack("<H", len(tags)) + b"".join(tags) + bytes(4)
        path.write_bytes(data)
    with pytest.raises(CaptureError, match=rf"{name}: has more than 64 million pixels"):
        read_photo(tmp_path / name)


def test_masks_that_fill_the_memory_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="its 700 masks have more than 640 million pixels"):
        read_masks([tmp_path / "a.png"] * 700, (1000, 1000))
