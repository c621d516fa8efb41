from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, fuse_burst
from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import ReadOptions, native, open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import CaptureError, DepthError, IntrinsicsError

Edit = Callable[[dict[str, Any]], object]


@pytest.fixture
def folder(capture: Capture, tmp_path: Path) -> Path:
    write_native(capture, tmp_path / "a")
    return tmp_path / "a"


def edit(folder: Path, change: Edit) -> None:
    data = json.loads((folder / "capture.json").read_text())
    change(data)
    (folder / "capture.json").write_text(json.dumps(data))


def load(path: Path, options: ReadOptions | None = None) -> Capture:
    (ref,) = open_source(path, options)
    return ref.load()


def test_a_folder_of_folders(capture: Capture, tmp_path: Path) -> None:
    for name in ("r2/b", "r1/a", "r2/a"):
        write_native(replace(capture, name=name.split("/")[1]), tmp_path / name)
    source = open_source(tmp_path)
    assert (source.kind, source.total) == ("native", 3)
    # In the folders' order, with names made unique.
    assert [r.name for r in source] == ["a", "a-2", "b"]
    assert [r.load().name for r in source] == ["a", "a-2", "b"]
    assert [r.frame for r in source] == [17, 17, 17]


def test_the_json_itself_may_be_named(folder: Path) -> None:
    assert load(folder / "capture.json").frame == 17


def test_one_broken_folder_loses_nothing_of_the_rest(capture: Capture, tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d"):
        write_native(replace(capture, name=name), tmp_path / name)
    (tmp_path / "b" / "capture.json").write_text("{")
    (tmp_path / "c" / "depth_000000.png").unlink()
    refs = list(open_source(tmp_path))
    assert [r.name for r in refs] == ["a", "b", "c", "d"]
    assert refs[0].load().name == "a"
    with pytest.raises(CaptureError, match=r"b/capture\.json: is not JSON"):
        refs[1].load()
    with pytest.raises(CaptureError, match=r"c/depth_000000\.png: the file is missing"):
        refs[2].load()
    assert refs[3].load().name == "d"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("camera"), "'camera': field required"),
        (lambda d: d["camera"].pop("stream"), "'camera.stream': field required"),
        (lambda d: d["camera"].pop("fx"), "'camera.fx': field required"),
        (lambda d: d.update(frames=[]), "'frames': list should have at least 1 item"),
        (lambda d: d.update(version=2), "'version': input should be 1"),
        (lambda d: d.update(format="other"), "'format': input should be 'cucumbervision-capture'"),
        (lambda d: d.update(depth_unit=0.001), "'depth_unit': extra inputs"),
        (lambda d: d.update(depth_unit_m=0), "'depth_unit_m': input should be greater than 0"),
        (lambda d: d["frames"][0].update(color="../x.png"), "must be a file in the capture's"),
        (lambda d: d["frames"][0].update(color="/etc/x.png"), "must be a file in the capture's"),
        (lambda d: d["frames"][0].update(depth="C:\\x.png"), "must be a file in the capture's"),
        (lambda d: d["stop"].update(position_m="far"), "'stop.position_m': input should be"),
    ],
)
def test_a_malformed_manifest_is_one_line(folder: Path, change: Edit, words: str) -> None:
    edit(folder, change)
    with pytest.raises(CaptureError, match=rf"capture\.json: .*{words}") as caught:
        load(folder)
    assert "\n" not in str(caught.value)


def test_intrinsics_of_the_depth_stream(folder: Path) -> None:
    edit(folder, lambda d: d["camera"].update(stream="depth"))
    with pytest.raises(IntrinsicsError, match=r"capture\.json: .*depth stream's"):
        load(folder)


def test_given_intrinsics_replace_or_are_refused(folder: Path, tmp_path: Path) -> None:
    given = tmp_path / "k.json"
    data = {"stream": "color", "width": 64, "height": 48, "fx": 61, "fy": 61, "cx": 32, "cy": 24}
    given.write_text(json.dumps(data))
    assert load(folder, ReadOptions(intrinsics=given)).intrinsics.fx_px == 61
    given.write_text(json.dumps(data | {"stream": "depth", "fx": 50}))
    # 60.5 / 50 - 1
    with pytest.raises(IntrinsicsError, match=r"k\.json: .*\+21 %"):
        load(folder, ReadOptions(intrinsics=given))
    with pytest.raises(CaptureError, match=r"none\.json: the file is missing"):
        open_source(folder, ReadOptions(intrinsics=tmp_path / "none.json"))


def test_depth_unit(folder: Path) -> None:
    halved = load(folder, ReadOptions(depth_unit_m=0.0005)).depth_m
    np.testing.assert_allclose(halved, load(folder).depth_m / 2, rtol=1e-6)
    edit(folder, lambda d: d.update(depth_unit_m=1.0))
    with pytest.raises(DepthError, match=r"depth_000000\.png: .*declared in metres.*millimetres"):
        load(folder)


def test_masks(folder: Path) -> None:
    path = folder / "mask_visib" / "000017_000001.png"
    write_png(path, np.zeros((48, 60), np.uint8))
    with pytest.raises(CaptureError, match=r"sizes differ: .*, mask 1 60x48"):
        load(folder)
    path.rename(folder / "mask_visib" / "000018_000001.png")
    with pytest.raises(CaptureError, match="named for frame 000018, the capture is frame 17"):
        load(folder)


def test_depth_of_a_burst_may_be_tiff_or_npy(folder: Path, capture: Capture) -> None:
    np.save(folder / "depth.npy", capture.depth_m)
    edit(folder, lambda d: d["frames"][0].update(depth="depth.npy"))
    edit(folder, lambda d: d.update(depth_unit_m=1.0))
    np.testing.assert_array_equal(load(folder).depth_m, capture.depth_m)


def test_a_burst_that_fills_the_memory_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "MOST_BURST_PIXELS", 3 * 48 * 64)
    edit(folder, lambda d: d.update(frames=3 * d["frames"]))
    assert load(folder).burst_size == 3
    edit(folder, lambda d: d.update(frames=4 * d["frames"][:1]))
    with pytest.raises(CaptureError, match=r"capture\.json: its frames have more than"):
        load(folder)


def test_round_trip_is_exact(capture: Capture, tmp_path: Path) -> None:
    assert write_native(capture, tmp_path / "a") == tmp_path / "a" / "capture.json"
    read = load(tmp_path / "a")
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
    np.testing.assert_array_equal(load(tmp_path / "a").depth_m, depth)


def test_what_rounding_loses_is_said(capture: Capture, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 3.0, (48, 64)).astype(np.float32)
    written = json.loads(write_native(replace(capture, depth_m=depth), tmp_path / "a").read_text())
    loss = np.abs(load(tmp_path / "a").depth_m - depth).max()
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
    read = load(tmp_path / "a").depth_m
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
    read = load(tmp_path / "a")
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
