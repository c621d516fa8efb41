from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable
from pathlib import Path, PureWindowsPath

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.intake.conftest import faults, send, zip_of

from cucumbervision.capture.source import safe_name
from cucumbervision.intake.archives import Limits, clean_name


@pytest.mark.parametrize("name", ["../x.png", "/etc/x.png", "a/../../x", "C:/x.png", "..\\x.png"])
def test_zips_that_lead_elsewhere_are_refused_whole(
    tmp_path: Path, name: str, depth_png: bytes, files_in: Callable[[Path], list[str]]
) -> None:
    got = send(tmp_path, a__zip=zip_of(("depth_1.png", depth_png), (name, depth_png)))
    assert "leads out of the zip" in faults(got)["a.zip"]
    assert not got.sources
    assert files_in(tmp_path) == ["in"]


def test_members_in_very_many_folders_are_refused(tmp_path: Path, depth_png: bytes) -> None:
    got = send(tmp_path, a__zip=zip_of(("a/" * 900 + "depth_1.png", depth_png)))
    assert "more than 32 folders" in faults(got)["a.zip"]


def test_a_path_too_long_for_the_file_system_is_said(tmp_path: Path, depth_png: bytes) -> None:
    name = "/".join(["é" * 110] * 24) + "/depth_1.png"
    got = send(tmp_path, a__zip=zip_of((name, depth_png)))
    assert "its member 'depth_1.png' cannot be kept (File name too long)" in faults(got)["a.zip"]
    assert not got.sources


DEVICES = ("CON", "prn.png", "AUX.tar.gz", "nul", "COM1.png", "lpt9", "COM².png", "CONIN$")


@pytest.mark.parametrize("name", [*DEVICES, "a.png.", "a. ", "a:b.png", 'x<>"|?*.png'])
def test_names_that_windows_gives_a_meaning_to_are_changed(name: str) -> None:
    is_valid_on_windows(clean_name(name))
    is_valid_on_windows(safe_name(name))


@given(st.text() | st.text("conauxlptm.: ²1", max_size=8))
def test_every_name_is_valid_on_windows(name: str) -> None:
    is_valid_on_windows(clean_name(name))
    is_valid_on_windows(safe_name(name))


def is_valid_on_windows(name: str) -> None:
    assert name
    assert not PureWindowsPath(name).is_reserved()
    assert not set(name) & {*'<>:"/\\|?*', *map(chr, range(32))}
    assert name == name.rstrip(". ")


def test_pictures_with_such_names_are_still_a_pair(
    tmp_path: Path, color_jpg: bytes, depth_png: bytes, intrinsics_json: bytes
) -> None:
    members = {"nul/intrinsics.json": intrinsics_json}
    members |= {"nul/rgb_12:30.jpg": color_jpg, "nul/depth_12:30.png": depth_png}
    (ref,) = send(tmp_path, a__zip=zip_of(*members.items())).sources[0].open()
    assert ref.load().source == "a.zip: _nul/rgb_12_30.jpg"


def test_members_of_one_name_are_refused(tmp_path: Path, depth_png: bytes) -> None:
    got = send(tmp_path, a__zip=zip_of(("depth_1.png", depth_png), ("./depth_1.png", depth_png)))
    assert "two members of one name" in faults(got)["a.zip"]


def test_links_in_zips_are_refused(tmp_path: Path) -> None:
    link = zipfile.ZipInfo("depth_1.png")
    link.create_system, link.external_attr = 3, 0o120777 << 16
    got = send(tmp_path, a__zip=zip_of((link, b"/etc/passwd")))
    assert "is a link or a device" in faults(got)["a.zip"]


def test_bombs_are_refused_by_ratio_size_and_number(tmp_path: Path) -> None:
    zeros = bytes(3_000_000)
    bomb = zip_of(("depth_1.png", zeros), ("depth_2.png", zeros))
    tight = Limits(ratio_from_bytes=1_000_000)
    assert "more than 200 times its size" in faults(send(tmp_path, tight, a__zip=bomb))["a.zip"]
    small = Limits(unpacked_bytes=4_000_000, ratio=2000)
    assert "unpacks to more" in faults(send(tmp_path, small, a__zip=bomb))["a.zip"]


def test_exactly_as_many_members_as_allowed_are_taken(tmp_path: Path, depth_png: bytes) -> None:
    two = {"colour_2.jpg": b"MZ", "depth_1.png": depth_png}
    packed = zip_of(*two.items(), ("__MACOSX/._x", b"0"), ("folder/", b""))
    for members, message in ((2, "has no matching picture"), (1, "holds more than 1 files")):
        got = send(tmp_path / str(members), Limits(members=members), a__zip=packed)
        assert message in " ".join(faults(got).values())
    # All zips of an upload share the number: the second zip's are one too many.
    got = send(tmp_path / "3", Limits(members=3), a__zip=packed, b__zip=packed)
    assert "has no matching picture" in faults(got)["a.zip: depth_1.png"]
    assert "holds more than 3 files" in faults(got)["b.zip"]
    got = send(tmp_path / "4", Limits(members=4), a__zip=packed, b__zip=packed)
    assert all("has no matching picture" in text for text in faults(got).values())


def test_a_zip_that_lies_about_its_sizes_is_stopped_while_unpacking(tmp_path: Path) -> None:
    data = bytearray(zip_of(("depth_1.png", bytes(3_000_000))))
    at = data.rfind(b"PK\x01\x02")
    data[at + 24 : at + 28] = struct.pack("<I", 100)  # uncompressed size, in the directory
    got = send(tmp_path, Limits(unpacked_bytes=1000), a__zip=bytes(data))
    assert list(faults(got)) == ["a.zip"]


def test_a_directory_too_large_for_memory_is_not_read(tmp_path: Path) -> None:
    data = bytearray(zip_of(("depth_1.png", b"x")))
    at = data.rfind(b"PK\x05\x06")
    data[at + 12 : at + 16] = struct.pack("<I", 100_000_000)
    got = send(tmp_path, a__zip=bytes(data))
    assert "holds more than 5000 files" in faults(got)["a.zip"]


def test_one_zip_in_a_zip_is_opened_and_a_deeper_one_not(tmp_path: Path, native_zip: bytes) -> None:
    once = zip_of(("inner.zip", native_zip))
    got = send(tmp_path, a__zip=once)
    assert [ref.name for ref in got.sources[0].open()] == ["stop_1", "stop_2"]
    got = send(tmp_path, a__zip=zip_of(("outer.zip", once)))
    assert "too deep" in " ".join(faults(got).values())
    assert not got.sources


def test_a_locked_zip_says_so(tmp_path: Path) -> None:
    data = bytearray(zip_of(("depth_1.png", b"x"), packed=False))
    for mark, offset in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        data[data.find(mark) + offset] |= 1
    assert "locked" in faults(send(tmp_path, a__zip=bytes(data)))["a.zip"]
