"""Damaged captures, cameras, labels and tables are read, or refused by a named error."""

from __future__ import annotations

import contextlib
import json
import math
import re
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.capsules import capsule_capture, lying

from cucumbervision import crop, measure_fruit
from cucumbervision.accuracy.truth import floor_of, read_truth
from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.capture.readers.common import choose_intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import CucumberVisionError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.label_files import read_instances
from cucumbervision.fruit.mask_codes import encode_rle

WIDTH, HEIGHT = 64, 48
LENS: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "fx": 60, "fy": 60, "cx": 31, "cy": 23}
ROWS = [60.0, 0, 31.0, 0, 60.0, 23.0, 0, 0, 1]
CAMERA = Intrinsics(
    *(WIDTH, HEIGHT, 60.5, 60.25, 31.5, 24.5),
    distortion=Distortion.INVERSE_BROWN_CONRADY,
    coefficients=(0.1, -0.05, 0.001, -0.002, 0.01),
)
COLOR = np.random.default_rng(3).integers(60, 200, (HEIGHT, WIDTH, 3), dtype=np.uint8)
DEPTH_MM = np.random.default_rng(4).integers(300, 900, (HEIGHT, WIDTH), dtype=np.uint16)
MASK = np.zeros((HEIGHT, WIDTH), bool)
MASK[20:30, 10:50] = True
POINTS = [[12.0 + 8 * k, 25.0, 2] for k in range(5)]


def png(image: np.ndarray[Any, Any]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def as_json(value: Any) -> bytes:
    return json.dumps(value).encode()


def native(folder: Path) -> None:
    stop = Stop(row="3", side="left", position_m=4.5, step=2)
    depth_m = (DEPTH_MM * 0.001).astype(np.float32)
    capture = Capture(COLOR, depth_m, CAMERA, "a", frame=17, masks=(MASK, ~MASK), stop=stop)
    write_native(capture, folder, burst=[(COLOR, depth_m + 0.001 * k) for k in range(3)])


def coco() -> dict[str, bytes]:
    shapes: list[Any] = [
        [[10.0, 20.0, 50.0, 20.0, 50.0, 30.0, 10.0, 30.0]],
        {"size": [HEIGHT, WIDTH], "counts": encode_rle(MASK)},
        {"size": [HEIGHT, WIDTH], "counts": [100, 20, HEIGHT * WIDTH - 120]},
    ]
    common = {"image_id": 1, "category_id": 1, "bbox": [10.0, 20.0, 40.0, 10.0], "iscrowd": 0}
    items = [{**common, "id": k, "segmentation": shape} for k, shape in enumerate(shapes)]
    points = [value for point in POINTS for value in point]
    items.append({**common, "id": 9, "keypoints": points, "num_keypoints": 5, "score": 0.9})
    image = {"id": 1, "file_name": "a.png", "width": WIDTH, "height": HEIGHT}
    kinds = [{"id": 1, "name": "cucumber", "keypoints": [f"KP{k}" for k in range(5)]}]
    whole = {"images": [image], "annotations": items, "categories": kinds}
    return {
        "coco.json": as_json(whole),
        "results.json": as_json([{**item, "score": 0.8} for item in items]),
    }


def yolo() -> dict[str, bytes]:
    pose = " ".join(f"{u / WIDTH:.6f} {v / HEIGHT:.6f} {seen}" for u, v, seen in POINTS)
    lines = ["0 0.5 0.5 0.2 0.4", "0 0.5 0.5 0.2 0.4 0.93", "1 0.1 0.1 0.4 0.1 0.4 0.5 0.1 0.5"]
    text = "\n".join([*lines, f"0 0.5 0.5 0.2 0.4 {pose}"])
    return {"a.txt": text.encode(), "classes.txt": b"cucumber\ncourgette\n"}


def cameras() -> dict[str, bytes]:
    shift = {"rotation": np.eye(3).tolist(), "translation_m": [0.015, 0.0, 0.0]}
    lens = {"distortion": "brown_conrady", "coefficients": [0.1, -0.05, 0.001, -0.002, 0.01]}
    size = {"width": WIDTH, "height": HEIGHT}
    whole = {"stream": "color", **LENS, **lens, "depth_unit_m": 0.001}
    realsense = {**size, "fx": 60, "fy": 60, "ppx": 31, "ppy": 23, "model": "brown_conrady"}
    ros = f"height: {HEIGHT}\nwidth: {WIDTH}\nD: [0.1, 0.0, 0.0, 0.0, 0.0]\nK: {ROWS}\n"
    return {
        "camera.json": as_json({**whole, "depth": LENS, "depth_to_color": shift}),
        "matrix.json": as_json({**size, "stream": "color", "matrix": np.eye(3).tolist()}),
        "realsense.json": as_json({**realsense, "coeffs": [0.1, 0, 0, 0, 0], "stream": "color"}),
        "ros.yaml": ros.encode(),
    }


def tables() -> dict[str, bytes]:
    head = "capture,fruit,length_1_cm,length_2_cm,kind,specimen"
    lines = [head, "a,1,20.5,20.7,thread,s1", "b,1,20.5,20.7,thread,s1", "b,missed,11.5,,chord,s2"]
    text = "\n".join(lines)
    german = text.replace(",", ";").replace(".", ",").encode("utf-8-sig")
    profile = Path(crop.__file__).parent / "crops" / "long-cucumber.toml"
    return {"truth.csv": text.encode(), "german.csv": german, "profile.toml": profile.read_bytes()}


def bop() -> dict[str, bytes]:
    return {
        "rgb/000001.png": png(COLOR),
        "depth/000001.png": png(DEPTH_MM),
        "mask_visib/000001_000000.png": png(MASK.astype(np.uint8) * 255),
        "scene_camera.json": as_json({"1": {"cam_K": ROWS, "depth_scale": 1.0}}),
    }


def pair() -> dict[str, bytes]:
    camera = as_json({"stream": "color", **LENS})
    return {"color_a.png": png(COLOR), "depth_a.png": png(DEPTH_MM), "intrinsics.json": camera}


def viewer() -> dict[str, bytes]:
    lens = "Intrinsic:\nFx,60.5\nFy,60.25\nPPx,31.5\nPPy,24.5\nDistorsion,Brown Conrady\n"
    size = f"Timestamp (ms),1700000000000.25\nResolution x,{WIDTH}\nResolution y,{HEIGHT}\n"
    files = {"a_Color.png": png(COLOR), "a_Depth.raw": DEPTH_MM.tobytes()}
    for kind, form in (("Depth", "Z16"), ("Color", "RGB8")):
        text = f"Frame Info\nType,{kind}\nFormat,{form}\nFrame Number,17\n{size}"
        files[f"a_{kind}_metadata.csv"] = f"{text}Bytes per pixel,2\n{lens}".encode()
    return files


def read_captures(folder: Path, _: str) -> None:
    camera = folder.parent / "camera.json"
    if not camera.exists():
        camera.write_bytes(cameras()["camera.json"])
    for ref in open_source(folder, ReadOptions(intrinsics=camera)):
        with contextlib.suppress(CucumberVisionError):
            ref.load()


def read_labels(folder: Path, name: str) -> None:
    read_instances(folder / name if name.endswith("json") else folder).for_capture(
        ["a.png"], WIDTH, HEIGHT, frame=1
    )


def read_camera(folder: Path, name: str) -> None:
    file = folder / name
    choose_intrinsics(None, read_camera_file(file), WIDTH, HEIGHT, source=file)


def read_table(folder: Path, name: str) -> None:
    if name.endswith("toml"):
        load_profile(folder / name)
    else:
        floor_of(read_truth(folder / name).lengths)


Reader = tuple[Callable[[], dict[str, bytes]] | None, Callable[[Path, str], None]]
READERS: dict[str, Reader] = {
    "native": (None, read_captures),
    "bop": (bop, read_captures),
    "pair": (pair, read_captures),
    "viewer": (viewer, read_captures),
    "coco": (coco, read_labels),
    "yolo": (yolo, read_labels),
    "cameras": (cameras, read_camera),
    "tables": (tables, read_table),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that overflow when multiplied
@pytest.mark.parametrize("name", READERS)
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_by_name(
    name: str, tmp_path: Path, data: st.DataObject
) -> None:
    make, read = READERS[name]
    folder = tmp_path / "in"
    shutil.rmtree(folder, ignore_errors=True)
    if make is None:
        native(folder)
    else:
        for path, content in make().items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
    file = data.draw(st.sampled_from(sorted(p for p in folder.rglob("*") if p.is_file())))
    file.write_bytes(damaged(file.read_bytes(), file.suffix.lstrip("."), data.draw))
    with contextlib.suppress(CucumberVisionError):
        read(folder, file.name)


FRUIT = capsule_capture(lying(0.16))
DEPTHS = st.sampled_from([0.0, 1e-6, 0.05, 0.3, 0.499, 0.5, 0.52, 0.8, 20.0, 65.535])


@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(
    patches=st.lists(
        st.tuples(st.integers(0, 639), st.integers(0, 359), st.integers(1, 120), DEPTHS), max_size=6
    ),
    outlines=st.lists(
        st.tuples(st.integers(0, 639), st.integers(0, 359), st.integers(1, 90), st.booleans()),
        max_size=4,
    ),
)
def test_any_depth_in_any_outline_is_measured_or_has_a_reason(
    patches: list[tuple[int, int, int, float]], outlines: list[tuple[int, int, int, bool]]
) -> None:
    depth_m, mask = FRUIT.depth_m.copy(), FRUIT.masks[0].copy()
    for u, v, size, depth in patches:
        depth_m[v : v + size, u : u + 2 * size] = depth
    for u, v, size, part in outlines:
        mask[v : v + size, u : u + 2 * size] = part
    capture = Capture(FRUIT.color, depth_m, FRUIT.intrinsics, "a", masks=(mask,))
    rows, columns = np.nonzero(mask)
    box = [columns.min(), rows.min(), columns.max(), rows.max()] if len(rows) else [1, 1, 9, 9]
    instance = Instance(np.array(box, float), mask=mask, mask_source=MaskSource.DATASET)
    fruit = measure_fruit(capture, instance)
    if fruit.length is None:
        assert str(fruit.reason)
        return
    assert 0 < fruit.length.value_m < math.inf
    if fruit.length.low_m is not None and fruit.length.high_m is not None:
        assert fruit.length.low_m <= fruit.length.value_m <= fruit.length.high_m


_PNG = b"\x89PNG\r\n\x1a\n"
_NUMBERS = st.one_of(
    st.sampled_from([0, -1, 5e-324, 1e-300, 1e300, 2**31, 2**63, 10**399, -(10**399)]),
    st.floats(),
    st.integers(),
)
_VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), _NUMBERS, st.text()),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)),
    max_leaves=8,
)
_WORDS = st.one_of(st.text(), _NUMBERS.map(repr), st.integers(0, 400).map("9".__mul__))


def damaged(data: bytes, ending: str, draw: Any) -> bytes:
    """Return a file's bytes with one to three changes; `ending` is its name's, without the dot."""
    for _ in range(draw(st.integers(1, 3))):
        if draw(st.integers(0, 3)) == 0:
            data = _bytes(data, draw)
        elif ending == "json":
            data = _tree(data, draw)
        elif data.startswith(_PNG):
            data = _chunk(data, draw)
        elif ending in ("csv", "txt", "toml", "yaml"):
            data = _word(data, draw)
        else:
            data = _bytes(data, draw)
    return data


def _bytes(data: bytes, draw: Any) -> bytes:
    start = draw(st.integers(0, len(data)))
    stop = draw(st.one_of(st.just(len(data)), st.integers(start, min(len(data), start + 16))))
    put: bytes = draw(st.binary(max_size=16))
    return data[:start] + put + data[stop:]


def _tree(data: bytes, draw: Any) -> bytes:
    """Change, remove or add one value anywhere in a JSON tree."""
    try:
        tree = [json.loads(data)]
    except (ValueError, RecursionError):
        return _bytes(data, draw)
    places: list[tuple[Any, Any]] = []
    waiting: list[Any] = [tree]
    while waiting:
        node = waiting.pop()
        items = list(node.items() if isinstance(node, dict) else enumerate(node))[:100]
        places += [(node, key) for key, _ in items]
        waiting += [value for _, value in items if isinstance(value, dict | list)]
    node, key = places[draw(st.integers(0, len(places) - 1))]
    what = draw(st.sampled_from(("value", "value", "value", "remove", "add")))
    if what == "value" or node is tree:
        node[key] = draw(_VALUES)
    elif what == "remove":
        del node[key]
    elif isinstance(node, dict):
        node[draw(st.text())] = draw(_VALUES)
    else:
        node.insert(key, draw(_VALUES))
    return json.dumps(tree[0], ensure_ascii=draw(st.booleans())).encode(errors="surrogatepass")


def _word(data: bytes, draw: Any) -> bytes:
    spans = [match.span() for match in re.finditer(rb"[^\s,;:=\[\]{}\"'<>]+", data)]
    if not spans:
        return _bytes(data, draw)
    start, stop = draw(st.sampled_from(spans))
    word: str = draw(_WORDS)
    return data[:start] + word.encode(errors="surrogatepass") + data[stop:]


def _chunk(data: bytes, draw: Any) -> bytes:
    """Change a chunk of a PNG, with the checksum that fits."""
    chunks, at = [], len(_PNG)
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    if not chunks:
        return _bytes(data, draw)
    k = draw(st.integers(0, len(chunks) - 1))
    chunks[k] = chunks[k][0], _bytes(chunks[k][1], draw)
    return _PNG + b"".join(
        len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
        for name, body in chunks
    )
