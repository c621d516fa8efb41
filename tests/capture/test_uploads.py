from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path, PureWindowsPath

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.capture.conftest import faults, send, zip_of

from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.capture.source import safe_name
from cucumbervision.capture.uploads import Limits, accept_uploads, clean_name
from cucumbervision.errors import CaptureError, IntrinsicsError, UploadError


def test_a_zip_of_native_captures_is_measured_as_it_was_sent(
    tmp_path: Path, native_zip: bytes
) -> None:
    got = send(tmp_path, walk__zip=native_zip)
    assert not got.refused
    assert got.ignored == ["walk.zip: README.txt"]
    (source,) = got.sources
    captures = [ref.load() for ref in source.open()]
    assert [c.name for c in captures] == ["stop_1", "stop_2"]
    assert captures[1].depth_m[0, 0] == np.float32(0.47)
    assert captures[0].masks[0].sum() == 400
    assert captures[0].source == "walk.zip: row 3/1"
    # The plain reader opens the same.
    assert open_source(source.path).total == 2


def test_a_recording_is_refused_with_what_to_do(tmp_path: Path) -> None:
    got = send(tmp_path, walk__BAG=b"#ROSBAG V2.0")
    assert not got.sources
    assert "round add" in faults(got)["walk.BAG"]


def test_loose_pairs_are_matched_by_name_and_go_by_it(
    tmp_path: Path, color_jpg: bytes, depth_png: bytes, intrinsics_json: bytes
) -> None:
    got = send(
        tmp_path,
        rgb_7__jpg=color_jpg,
        depth_7__png=depth_png,
        depth_8__png=depth_png,
        intrinsics__json=intrinsics_json,
    )
    (source,) = got.sources
    whole, alone = source.open()
    assert whole.load().name == "rgb_7"
    with pytest.raises(CaptureError, match=r"^depth_8\.png: has no colour picture"):
        alone.load()


def test_pictures_without_any_partner_are_refused_each(tmp_path: Path, depth_png: bytes) -> None:
    got = send(tmp_path, depth_8__png=depth_png, notes__txt=b"hello")
    assert "has no matching picture" in faults(got)["depth_8.png"]
    assert got.ignored == ["notes.txt"]
    assert not got.folder.exists()


def test_pairs_without_intrinsics_need_the_users(
    tmp_path: Path, color_jpg: bytes, depth_png: bytes, intrinsics_json: bytes
) -> None:
    got = send(tmp_path, rgb_7__jpg=color_jpg, depth_7__png=depth_png)
    with pytest.raises(CaptureError, match=r"^upload: "):
        got.sources[0].open()
    own = tmp_path / "own.json"
    own.write_bytes(intrinsics_json)
    (ref,) = got.sources[0].open(ReadOptions(intrinsics=own))
    assert ref.load().depth_m[0, 0] == np.float32(0.45)


def test_the_same_names_from_two_folders_stay_two_pairs(
    tmp_path: Path, color_jpg: bytes, depth_png: bytes, intrinsics_json: bytes
) -> None:
    files = [
        *(("color.jpg", io.BytesIO(color_jpg)) for _ in range(2)),
        *(("depth.png", io.BytesIO(depth_png)) for _ in range(2)),
        ("intrinsics.json", io.BytesIO(intrinsics_json)),
    ]
    got = accept_uploads(files, tmp_path / "in")
    assert not got.refused
    assert sum(source.open().total or 0 for source in got.sources) == 2


def test_what_it_is_goes_by_the_bytes_and_not_by_the_ending(
    tmp_path: Path, color_jpg: bytes, depth_png: bytes, intrinsics_json: bytes
) -> None:
    got = send(
        tmp_path,
        color__png=color_jpg,
        depth__tif=depth_png,
        intrinsics__json=intrinsics_json,
        evil__exe=b"MZ\x90",
        empty__png=b"",
    )
    (ref,) = got.sources[0].open()
    assert ref.load().fill == 1.0
    assert "not a file type we can read" in faults(got)["evil.exe"]
    assert "empty" in faults(got)["empty.png"]


def test_an_npz_is_refused_and_not_unpacked(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.savez(stream, depth_1=np.zeros(3))
    got = send(tmp_path, walk__npz=stream.getvalue())
    assert "not a file type we can read" in faults(got)["walk.npz"]


def test_errors_on_reading_name_what_was_sent(
    tmp_path: Path, color_jpg: bytes, depth_png: bytes, intrinsics_json: bytes
) -> None:
    got = send(
        tmp_path,
        rgb_7__jpg=color_jpg,
        depth_7__png=depth_png[:-20],
        intrinsics__json=intrinsics_json.replace(b'"color"', b'"depth"'),
    )
    (ref,) = got.sources[0].open()
    with pytest.raises(IntrinsicsError, match=r"^intrinsics\.json: "):
        ref.load()


def test_size_and_count_limits(tmp_path: Path, depth_png: bytes) -> None:
    with pytest.raises(UploadError, match="3 files were sent, at most 2"):
        send(tmp_path, Limits(files=2), a=b"", b=b"", c=b"")
    got = send(tmp_path, Limits(total_bytes=50), depth__png=depth_png)
    assert "more than the" in faults(got)["depth.png"]
    got = send(tmp_path, Limits(text_bytes=50), a__json=b'{"a": "' + b"x" * 100 + b'"}')
    assert "more than the" in faults(got)["a.json"]


def test_names_are_shown_clean(tmp_path: Path) -> None:
    got = accept_uploads([("../a\x00b\u202e/..\\evil\n.png", io.BytesIO(b"MZ"))], tmp_path)
    assert got.refused[0].source == "ab/evil.png"
    assert list(tmp_path.iterdir()) == []


def test_a_zip_without_captures_says_what_it_holds(tmp_path: Path) -> None:
    got = send(tmp_path, a__zip=zip_of(("a.txt", b"x"), ("b.txt", b"y"), ("c", b"z")))
    assert "recognised, but 2 .txt, 1 other; pack capture folders" in faults(got)["a.zip"]


def test_paths_are_taken_too_and_folders_refused(tmp_path: Path, native_zip: bytes) -> None:
    (tmp_path / "walk.zip").write_bytes(native_zip)
    files = [("walk.zip", tmp_path / "walk.zip"), ("folder", tmp_path), ("none", tmp_path / "none")]
    got = accept_uploads(files, tmp_path / "in")
    assert len(got.sources) == 1
    assert set(faults(got)) == {"folder", "none"}
    assert (tmp_path / "walk.zip").exists()


@pytest.mark.parametrize("name", ["../x.png", "/etc/x.png", "a/../../x", "..\\x.png"])
def test_zips_that_lead_elsewhere_are_refused_whole(
    tmp_path: Path, name: str, depth_png: bytes, files_in: Callable[[Path], list[str]]
) -> None:
    got = send(tmp_path, a__zip=zip_of(("depth_1.png", depth_png), (name, depth_png)))
    assert "leads out of the zip" in faults(got)["a.zip"]
    assert not got.sources
    assert files_in(tmp_path) == ["in"]


def test_a_path_too_long_for_the_file_system_is_said(tmp_path: Path, depth_png: bytes) -> None:
    name = "/".join(["é" * 110] * 24) + "/depth_1.png"
    got = send(tmp_path, a__zip=zip_of((name, depth_png)))
    assert "cannot be kept (File name too long)" in str(got.refused[0])
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
    assert "File exists" in faults(got)["a.zip: depth_1.png"]


def test_bombs_are_refused_by_size(tmp_path: Path) -> None:
    bomb = zip_of(*((f"depth_{k}.png", bytes(3_000_000)) for k in (1, 2)))
    got = send(tmp_path, Limits(unpacked_bytes=4_000_000), a__zip=bomb)
    assert "MB that are taken" in str(got.refused[0])


def test_exactly_as_many_members_as_allowed_are_taken(tmp_path: Path, depth_png: bytes) -> None:
    two = {"colour_2.jpg": b"MZ", "depth_1.png": depth_png}
    packed = zip_of(*two.items(), ("folder/", b""))
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
    assert "is damaged" in faults(got)["a.zip"]


def test_a_zip_in_a_zip_is_refused(tmp_path: Path, native_zip: bytes) -> None:
    got = send(tmp_path, a__zip=zip_of(("inner.zip", native_zip)))
    assert "recognised, but 1 .zip" in faults(got)["a.zip"]
    assert not got.sources


def test_a_locked_zip_says_so(tmp_path: Path) -> None:
    data = bytearray(zip_of(("depth_1.png", b"x"), packed=False))
    for mark, offset in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        data[data.find(mark) + offset] |= 1
    assert "encrypted" in faults(send(tmp_path, a__zip=bytes(data)))["a.zip"]
