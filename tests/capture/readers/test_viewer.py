from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.pictures import write_png
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.errors import CaptureError, DepthError, IntrinsicsError

COLOR = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
CAMERA = {
    "stream": "color",
    "width": 64,
    "height": 48,
    "fx": 60,
    "fy": 60,
    "cx": 32,
    "cy": 24,
    "depth_to_color": {
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "translation_m": [0.05, 0, 0],
    },
}
TABLE = """Frame Info:
Type,{stream}
Format,{format}
Frame Number,123
Timestamp (ms),1700000000250.00
Resolution x,{width}
Resolution y,{height}
Bytes per pixel,2

Intrinsic:,
Fx,{f}
Fy,{f}
PPx,{cx}
PPy,{cy}
Distorsion,Brown Conrady
"""
DEPTH = {"stream": "Depth", "format": "Z16", "width": 32, "height": 24, "f": 25, "cx": 16, "cy": 12}


def export(folder: Path, base: str = "row3", **table: Any) -> Path:
    folder.mkdir(exist_ok=True)
    depth = np.zeros((24, 32), "<u2")
    depth[10, 20] = 500
    (folder / f"{base}_Depth.raw").write_bytes(depth.tobytes())
    (folder / f"{base}_Depth_metadata.csv").write_text(TABLE.format(**DEPTH | table))
    write_png(folder / f"{base}_Color.png", COLOR)
    write_png(folder / f"{base}_Depth.png", np.full((24, 32, 3), 9, np.uint8))
    return folder


def given(folder: Path, **change: Any) -> ReadOptions:
    path = folder / "k.json"
    path.write_text(json.dumps({k: v for k, v in (CAMERA | change).items() if v is not None}))
    return ReadOptions(intrinsics=path)


def test_snapshot_is_aligned(tmp_path: Path) -> None:
    source = open_source(export(tmp_path / "v"), given(tmp_path))
    assert (source.kind, source.total) == ("viewer", 1)
    (ref,) = source
    capture = ref.load()
    assert (ref.name, ref.frame, capture.frame) == ("row3", 123, 123)
    assert capture.timestamp_s == 1_700_000_000.25
    np.testing.assert_array_equal(capture.color, COLOR)
    ys, xs = np.nonzero(capture.depth_m)
    # As in test_pair: x from 46.4 to 48.8, y from 18 to 20.4.
    assert (xs.min(), xs.max(), ys.min(), ys.max()) == (46, 49, 18, 20)
    assert capture.depth_m[19, 47] == np.float32(0.5)


def test_depth_block_and_unit_of_the_file_go_first(tmp_path: Path) -> None:
    depth = {"width": 32, "height": 24, "fx": 25, "fy": 25, "cx": 17, "cy": 12}
    options = given(tmp_path, depth=depth, depth_unit_m=0.0005)
    (ref,) = open_source(export(tmp_path / "v"), options)
    capture = ref.load()
    # One depth pixel to the left is 60/25 = 2.4 px; at half the distance the shift doubles, 12 px.
    _, xs = np.nonzero(capture.depth_m)
    assert (xs.min(), xs.max()) == (46 - 2 + 6, 49 - 3 + 6)
    assert capture.depth_m.max() == np.float32(0.25)


def test_several_snapshots_and_a_broken_one(tmp_path: Path) -> None:
    for base in ("a", "b", "c", "d", "e"):
        export(tmp_path / "v", base)
    (tmp_path / "v/b_Depth.raw").unlink()
    (tmp_path / "v/c_Depth_metadata.csv").unlink()
    (tmp_path / "v/d_Depth.raw").write_bytes(b"1234")
    (tmp_path / "v/e_Color.png").unlink()
    refs = {r.name: r for r in open_source(tmp_path / "v", given(tmp_path))}
    assert list(refs) == ["a", "b", "c", "d", "e"]
    assert refs["a"].load().frame == 123
    for name, words in {
        "b": r"b_Depth\.png: is the Viewer's colourised picture.*b_Depth\.raw",
        "c": r"c_Depth_metadata\.csv: the file is missing",
        "d": r"d_Depth\.raw: has 4 bytes, but 32x24 of 16 bits are 1536",
        "e": r"e_Color\.png: the file is missing",
    }.items():
        with pytest.raises(CaptureError, match=words):
            refs[name].load()


def test_the_colourised_picture_alone_is_refused(tmp_path: Path) -> None:
    folder = export(tmp_path / "v")
    (folder / "row3_Depth.raw").unlink()
    (folder / "row3_Depth_metadata.csv").unlink()
    (ref,) = open_source(folder, given(tmp_path, depth_to_color=None))
    with pytest.raises(DepthError, match=r"row3_Depth\.png: .*colourised"):
        ref.load()


def test_extrinsics_are_needed(tmp_path: Path) -> None:
    folder = export(tmp_path / "v")
    with pytest.raises(IntrinsicsError, match=r"v: .*not aligned to colour.*'depth_to_color'"):
        open_source(folder)
    with pytest.raises(IntrinsicsError, match=r"k\.json: .*not aligned to colour"):
        open_source(folder, given(tmp_path, depth_to_color=None))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"format": "Z16H"}, "holds Z16H, not Z16"),
        ({"width": "wide"}, "is damaged or of another form"),
        ({"f": 0}, "do not describe a camera"),
        ({"width": 30}, "has 1536 bytes, but 30x24"),
    ],
)
def test_bad_tables(table: dict[str, Any], words: str, tmp_path: Path) -> None:
    (ref,) = open_source(export(tmp_path / "v", **table), given(tmp_path))
    with pytest.raises(CaptureError, match=words):
        ref.load()


def test_the_color_table_tells_what_depth_intrinsics_would_do(tmp_path: Path) -> None:
    folder = export(tmp_path / "v")
    color = {"stream": "Color", "format": "RGB8", "width": 64, "height": 48, "f": 60}
    table = TABLE.format(**DEPTH | color)
    (folder / "row3_Color_metadata.csv").write_text(table)
    (ref,) = open_source(folder, given(tmp_path, stream="depth", fx=50))
    with pytest.raises(IntrinsicsError, match=r"k\.json: .*\+20 %"):
        ref.load()
