"""Captures to read and to write, and what strangers may send."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Distortion, Intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.uploads import AcceptedUploads, Limits, accept_uploads

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
INTRINSICS = {"stream": "color", "width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 31, "cy": 23}


@pytest.fixture
def capture() -> Capture:
    """A small capture in which no two parts are alike."""
    rng = np.random.default_rng(3)
    mask = np.zeros((48, 64), bool)
    mask[20:30, 10:50] = True
    return Capture(
        rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
        (rng.integers(300, 900, (48, 64)) * 0.001).astype(np.float32),
        Intrinsics(
            64,
            48,
            60.5,
            60.25,
            31.5,
            24.5,
            distortion=Distortion.INVERSE_BROWN_CONRADY,
            coefficients=(0.1, -0.05, 0.001, -0.002, 0.01),
        ),
        name="row3_left_2",
        frame=17,
        burst_frame=2,
        burst_size=5,
        masks=(mask, ~mask),
        stop=Stop(row="3", side="left", position_m=4.5, step=2),
        timestamp_s=1_700_000_000.25,
        simulated=True,
        source="made here",
        provenance={"camera": "D435", "serial": "1234"},
    )


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real captures; tests that need it are skipped without it."""
    folder = os.environ.get("CUCUMBERVISION_DATA", "")
    if not folder or not Path(folder).is_dir():
        pytest.skip("CUCUMBERVISION_DATA names no folder of real captures")
    return Path(folder)


def encoded(suffix: str, image: np.ndarray) -> bytes:
    done, data = cv2.imencode(suffix, image)
    assert done
    return bytes(data.tobytes())


def zipped(members: Mapping[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return stream.getvalue()


@pytest.fixture(scope="session")
def color_jpg() -> bytes:
    return encoded(".jpg", np.full((48, 64, 3), 90, np.uint8))


@pytest.fixture(scope="session")
def depth_png() -> bytes:
    return encoded(".png", np.full((48, 64), 450, np.uint16))


@pytest.fixture(scope="session")
def intrinsics_json() -> bytes:
    return json.dumps(INTRINSICS).encode()


@pytest.fixture(scope="session")
def native_zip(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Two native captures of one fruit each, in a folder, and a page about them."""
    folder = tmp_path_factory.mktemp("native")
    mask = np.zeros((48, 64), bool)
    mask[20:30, 10:50] = True
    for number in (1, 2):
        depth_m = np.full((48, 64), 0.45 + 0.01 * number, np.float32)
        capture = Capture(
            np.zeros((48, 64, 3), np.uint8), depth_m, CAMERA, f"stop {number}", masks=(mask,)
        )
        write_native(capture, folder / "row 3" / str(number))
    members = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    return zipped(members | {"README.txt": b"our first walk", "__MACOSX/._x": b"\0"})


@pytest.fixture
def files_in() -> Callable[[Path], list[str]]:
    """List all files below a folder, and folders that are empty."""

    def listed(folder: Path) -> list[str]:
        return sorted(
            p.relative_to(folder).as_posix()
            for p in folder.rglob("*")
            if p.is_file() or not any(p.iterdir())
        )

    return listed


def send(folder: Path, limits: Limits | None = None, **files: bytes) -> AcceptedUploads:
    """Send files; 'a__b' stands for a.b and 'a___b' for a/b."""
    named = [(n.replace("___", "/").replace("__", "."), io.BytesIO(d)) for n, d in files.items()]
    return accept_uploads(named, folder / "in", limits)


def faults(got: AcceptedUploads) -> dict[str, str]:
    return {one.source: str(one) for one in got.refused}


def zip_of(*members: tuple[str | zipfile.ZipInfo, bytes], packed: bool = True) -> bytes:
    stream = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream, "w", kind) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return stream.getvalue()
