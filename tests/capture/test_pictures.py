from __future__ import annotations

import pickle
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.arrays import Numbers, Pixels
from cucumbervision.capture.pictures import (
    depth_to_metres,
    read_color,
    read_depth,
    read_masks,
    read_photo,
    require_readings,
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
    with pytest.raises(DepthError, match=r"d\.npy: .*Object arrays.*numpy\.save"):
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


def test_a_mask_is_what_is_not_zero(tmp_path: Path) -> None:
    mask = np.zeros((30, 40), np.uint8)
    mask[3:5, 6] = 1
    write_png(tmp_path / "m.png", mask)
    (read,) = read_masks([tmp_path / "m.png"], (30, 40, 3))
    np.testing.assert_array_equal(read, mask > 0)


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


PLAUSIBLE = np.linspace(0.3, 2.0, 100).reshape(10, 10)


@pytest.mark.parametrize(
    ("raw", "unit_m", "expected_m"),
    [
        (np.array([[454]], np.uint16), None, 0.454),
        (np.array([[4540]], np.uint16), 0.0001, 0.454),
        (np.array([[454]], np.int32), None, 0.454),
        (np.array([[0.454]], np.float64), None, 0.454),
        (np.array([[454.0]], np.float32), 0.001, 0.454),
        (np.array([[[454]]], np.uint16), None, 0.454),
    ],
)
def test_units(raw: Any, unit_m: float | None, expected_m: float) -> None:
    depth_m = depth_to_metres(raw, unit_m)
    assert depth_m.dtype == np.float32
    assert depth_m.tolist() == [[np.float32(expected_m)]]


@pytest.mark.parametrize(
    ("raw", "unit_m", "words"),
    [
        (PLAUSIBLE, 0.001, "declared in millimetres.*100 % .*outside.*in metres 100 % lie inside"),
        ((PLAUSIBLE * 1000).astype(np.uint16), 1.0, "declared in metres.*in millimetres 100 %"),
        (PLAUSIBLE * 1000, None, "declared in metres.*in millimetres"),
        (PLAUSIBLE, 0.0001, r"steps of 0.1 mm.*in metres.*depth unit 1 m"),
        # 0.7 m in steps of 0.1 mm, which in steps of 0.2 mm is 1.4 m.
        (np.full((4, 4), 7000, np.uint16), None, r"in steps of 0.1 mm.*0.0001 m or 0.0002 m"),
        (np.full((4, 4), 28000, np.uint16), 0.001, r"in steps of 0.1 mm.*unit 0.0001 m$"),
    ],
)
def test_the_wrong_unit_is_named(raw: Any, unit_m: float | None, words: str) -> None:
    with pytest.raises(DepthError, match=words):
        depth_to_metres(raw, unit_m, source="a.png")


def test_shares_of_the_largest_distance_are_no_metres() -> None:
    shares = (PLAUSIBLE / PLAUSIBLE.max()).astype(np.float32)
    with pytest.raises(DepthError, match=r"a\.npy: .*no metres; .*declare the depth unit 1 m"):
        depth_to_metres(shares, source="a.npy")
    assert depth_to_metres(shares, 1.0).max() == 1.0
    clipped = np.minimum(np.rint(1000 * PLAUSIBLE) / 1000, 1.0).astype(np.float32)
    assert depth_to_metres(clipped).max() == 1.0


def test_holes_do_not_count_against_a_unit() -> None:
    raw = np.zeros((10, 10), np.uint16)
    raw[0, 0] = 450
    assert depth_to_metres(raw)[0, 0] == np.float32(0.45)


@pytest.mark.parametrize(
    "raw",
    [
        np.ones((4, 4), np.uint8),
        np.ones((4, 4), bool),
        np.ones((4, 4), complex),
        np.ones((4, 4, 3), np.uint16),
        np.ones(4, np.uint16),
        np.ones((0, 4), np.uint16),
    ],
)
def test_what_is_no_depth_is_refused(raw: Any) -> None:
    with pytest.raises(DepthError, match=r"a\.png.*give the 16-bit depth itself"):
        depth_to_metres(raw, source="a.png")


@pytest.mark.parametrize(
    ("value_m", "words"),
    [(0.0, "every pixel is 0"), (7.0, "readings run from 7 to 7 m"), (0.05, "from 0.05 to")],
)
def test_depth_without_readings_is_refused(value_m: float, words: str) -> None:
    with pytest.raises(DepthError, match=words):
        require_readings(np.full((4, 4), value_m, np.float32), source="a")
    depth = np.full((4, 4), value_m, np.float32)
    depth[1, 1] = 0.5
    require_readings(depth)


@pytest.mark.parametrize("unit_m", [1e-300, 1e300])
def test_a_step_that_no_camera_has_is_refused(unit_m: float) -> None:
    with pytest.raises(DepthError, match=re.escape(f"steps of {unit_m:g} m")):
        depth_to_metres(np.full((4, 4), 454, np.uint16), unit_m)


GREEN, GREY = (40, 160, 60), 114


def photo() -> Pixels:
    """40 wide and 24 high: a green field, its upper left quarter red."""
    image = np.full((24, 40, 3), GREEN, np.uint8)
    image[:12, :20] = (200, 30, 20)
    return image


def write_photo(path: Path, image: Numbers) -> Path:
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
    read = read_photo(write_photo(tmp_path / f"a{suffix}", photo()))
    assert read.dtype == np.uint8
    assert np.abs(read[20, 35].astype(int) - GREEN).max() < 12
    assert np.abs(read[4, 5].astype(int) - (200, 30, 20)).max() < 12


@pytest.mark.parametrize(
    ("orientation", "red"), [(1, (4, 5)), (3, (19, 34)), (6, (5, 19)), (8, (34, 4))]
)
def test_exif_turns_the_picture(tmp_path: Path, orientation: int, red: tuple[int, int]) -> None:
    path = write_photo(tmp_path / "a.jpg", photo())
    path.write_bytes(with_orientation(path.read_bytes(), orientation))
    read = read_photo(path)
    # 6 and 8 lie on a side (CIPA DC-008, 4.6.4).
    assert read.shape == ((24, 40, 3) if orientation in (1, 3) else (40, 24, 3))
    assert read[red][0] > 150
    assert sum(read[v, u][0] > 150 for v in (5, -6) for u in (5, -6)) == 1


def test_sixteen_bits_grey_and_both(tmp_path: Path) -> None:
    deep = write_photo(tmp_path / "deep.png", photo().astype(np.uint16) * 257)
    assert np.array_equal(read_photo(deep), photo())
    grey = np.linspace(0, 255, 40).astype(np.uint8)[None].repeat(24, axis=0)
    for image in (grey, grey.astype(np.uint16) * 257):
        read = read_photo(write_photo(tmp_path / "grey.png", image))
        assert np.array_equal(read, grey[..., None].repeat(3, axis=2))


@pytest.mark.parametrize("levels", [np.uint8, np.uint16])
def test_what_is_transparent_lies_on_grey(tmp_path: Path, levels: type) -> None:
    scale = 257 if levels is np.uint16 else 1
    alpha = np.full((24, 40), 255, np.uint8)
    alpha[:, 20:] = 0
    bgra = np.dstack([photo()[..., ::-1], alpha]).astype(levels) * levels(scale)
    read = read_photo(write_photo(tmp_path / "a.png", bgra))
    assert np.array_equal(read[:, :20], photo()[:, :20])
    assert (read[:, 20:] == GREY).all()


def test_what_is_no_picture_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.jpg").write_text("hello")
    (tmp_path / "cut.png").write_bytes(write_photo(tmp_path / "a.png", photo()).read_bytes()[:-20])
    (tmp_path / "cut.tiff").write_bytes(write_photo(tmp_path / "a.tiff", photo()).read_bytes()[:90])
    (tmp_path / "empty.webp").write_bytes(b"")
    for name in ("text.jpg", "cut.png", "cut.tiff", "empty.webp", "none.bmp"):
        with pytest.raises(CaptureError, match=name):
            read_photo(tmp_path / name)
    # OpenCV itself keeps quiet about it.
    assert capfd.readouterr().err == ""


def test_floats_have_no_white(tmp_path: Path) -> None:
    image = photo().astype(np.float32)
    with pytest.raises(CaptureError, match=r"float32.*8 or 16 bits"):
        read_photo(write_photo(tmp_path / "a.tiff", image))
