"""What inputs hold is read once, and what belongs to no capture is said."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import ReadOptions
from cucumbervision.capture.readers.native import write_native
from cucumbervision.run.batch import count_captures, read_captures
from cucumbervision.run.measurer import Failure


def test_a_path_by_two_ways_is_read_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    depth_m = np.full((48, 64), 0.45, np.float32)
    color, camera = np.zeros((48, 64, 3), np.uint8), Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    for name in ("süd", "黄瓜"):
        write_native(Capture(color, depth_m, camera, name), tmp_path / name)
    (tmp_path / "link").symlink_to(tmp_path / "süd")
    inputs = [tmp_path / "süd", tmp_path / "link", tmp_path / "黄瓜", tmp_path / "." / "黄瓜"]
    with caplog.at_level(logging.WARNING):
        found = list(read_captures(inputs, ReadOptions()))
    # Names keep the letters of their alphabet.
    assert [one.name for one in found if not isinstance(one, Failure)] == ["süd", "黄瓜"]
    assert count_captures(inputs, ReadOptions()) == 2
    assert [r.getMessage().split(" is ", 1)[1] for r in caplog.records] == [
        "given twice: it is measured once"
    ] * 2


def test_pictures_that_belong_to_no_capture_are_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    depth_m = np.full((48, 64), 0.45, np.float32)
    color, camera = np.zeros((48, 64, 3), np.uint8), Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    write_native(Capture(color, depth_m, camera, "a"), tmp_path / "a")
    (tmp_path / "depth_7.png").write_bytes(b"x")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "rgb_8.jpg").write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "house.jpg").write_bytes(b"x")
    with caplog.at_level(logging.WARNING):
        found = list(read_captures([tmp_path], ReadOptions()))
    assert [one.name for one in found if not isinstance(one, Failure)] == ["a"]
    said = f"{tmp_path}: 2 pictures belong to no capture: depth_7.png, b/rgb_8.jpg"
    assert [record.getMessage() for record in caplog.records] == [said]
