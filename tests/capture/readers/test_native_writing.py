from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, fuse_burst
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import CaptureError


def back(folder: Path) -> Capture:
    (ref,) = open_source(folder)
    return ref.load()


def test_round_trip_is_exact(capture: Capture, tmp_path: Path) -> None:
    assert write_native(capture, tmp_path / "a") == tmp_path / "a" / "capture.json"
    read = back(tmp_path / "a")
    np.testing.assert_array_equal(read.color, capture.color)
    np.testing.assert_array_equal(read.depth_m, capture.depth_m)
    assert read.depth_m.dtype == np.float32
    assert len(read.masks) == 2
    np.testing.assert_array_equal(read.masks, capture.masks)
    for part in (
        "intrinsics",
        "name",
        "frame",
        "burst_frame",
        "burst_size",
        "stop",
        "timestamp_s",
        "simulated",
        "provenance",
    ):
        assert getattr(read, part) == getattr(capture, part), part
    assert read.source == str(tmp_path / "a")


def test_depth_between_millimetres_gets_a_finer_unit(capture: Capture, tmp_path: Path) -> None:
    depth = np.full((48, 64), 0.4545, np.float32)
    path = write_native(replace(capture, depth_m=depth), tmp_path / "a")
    written = json.loads(path.read_text())
    assert (written["depth_unit_m"], written["depth_rounding_m"]) == (0.0005, 0.0)
    np.testing.assert_array_equal(back(tmp_path / "a").depth_m, depth)


def test_what_rounding_loses_is_said(capture: Capture, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 3.0, (48, 64)).astype(np.float32)
    written = json.loads(write_native(replace(capture, depth_m=depth), tmp_path / "a").read_text())
    loss = np.abs(back(tmp_path / "a").depth_m - depth).max()
    # The finest step is 0.05 mm, of which half can be lost.
    assert 0.00002 < loss <= 0.0000251
    assert written["depth_rounding_m"] == pytest.approx(loss, abs=1e-6)
    # Beyond 3.3 m 16 bits of it are too few.
    depth[0, 0] = 4.0
    written = json.loads(write_native(replace(capture, depth_m=depth), tmp_path / "b").read_text())
    assert written["depth_unit_m"] == 0.0001


def test_no_readings_stay_none_and_far_ones_stay(capture: Capture, tmp_path: Path) -> None:
    depth = capture.depth_m.copy()
    depth[0, :4] = (0.0, np.nan, np.inf, -1.0)
    depth[0, 4] = 12.0
    write_native(replace(capture, depth_m=depth), tmp_path / "a")
    read = back(tmp_path / "a").depth_m
    assert read[0, :5].tolist() == [0.0, 0.0, 0.0, 0.0, 12.0]


def test_depth_too_far_for_16_bits_is_refused(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"70 m, too far"):
        write_native(replace(capture, depth_m=np.full((48, 64), 70.0, np.float32)), tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_unfused_burst_is_fused_when_read(capture: Capture, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    color = rng.integers(0, 50, (6, 8, 3), np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    frames = [
        (
            color * 5 // 4 if i == 1 else color,
            (rng.integers(400, 420, (48, 64)) * 0.001).astype(np.float32),
        )
        for i in range(4)
    ]
    write_native(capture, tmp_path / "a", burst=frames, timestamps_s=[1.0, 2.0, 3.0, 4.0])
    read = back(tmp_path / "a")
    fused = fuse_burst([c for c, _ in frames], [d for _, d in frames])
    assert (fused.burst_frame, read.burst_frame, read.timestamp_s) == (1, 1, 2.0)
    assert (fused.burst_size, read.burst_size) == (4, 4)
    np.testing.assert_array_equal(read.color, fused.color)
    np.testing.assert_array_equal(read.depth_m, fused.depth_m)
    assert (read.name, read.frame, len(read.masks)) == (capture.name, capture.frame, 2)


def test_a_folder_is_never_written_twice(capture: Capture, tmp_path: Path) -> None:
    write_native(capture, tmp_path / "a")
    with pytest.raises(CaptureError, match="already holds a capture"):
        write_native(capture, tmp_path / "a")
