"""Broken files of every kind: named errors only, and a folder as clean as before."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cucumbervision.capture.uploads import AcceptedSource, Limits, accept_uploads
from cucumbervision.errors import CucumberVisionError

LIMITS = Limits(unpacked_bytes=3_000_000, file_bytes=1_000_000, members=50)
FUZZ = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
DAMAGE = st.tuples(
    st.lists(st.tuples(st.floats(0, 1), st.integers(1, 255)), max_size=8), st.floats(0, 1)
)


def damaged(data: bytes, damage: tuple[list[tuple[float, int]], float]) -> bytes:
    """Flip bits at relative places, and cut the file where the second number is under 0.3."""
    flips, cut = damage
    broken = bytearray(data)
    for place, bits in flips:
        broken[round(place * (len(broken) - 1))] ^= bits
    return bytes(broken[: round(len(broken) * cut / 0.3)] if cut < 0.3 else broken)


def read_all(source: AcceptedSource) -> list[str]:
    """Read every capture; give the named errors."""
    faults = []
    try:
        for ref in source.open():
            try:
                capture = ref.load()
            except CucumberVisionError as error:
                faults.append(str(error))
            else:
                assert capture.depth_m.shape == capture.color.shape[:2]
    except CucumberVisionError as error:
        faults.append(str(error))
    return faults


def receive(name: str, data: bytes) -> None:
    """Send a file, read what came of it, and look at what was left behind."""
    with tempfile.TemporaryDirectory() as tmp:
        folder = Path(tmp) / "in"
        got = accept_uploads([(name, io.BytesIO(data))], folder, LIMITS)
        assert got.sources or got.refused or got.ignored
        for one in got.refused:
            assert isinstance(one, CucumberVisionError)
            assert len(str(one).splitlines()) == 1
        for source in got.sources:
            assert source.path.is_relative_to(got.folder)
            assert tmp not in " ".join(read_all(source))
        assert not [*got.folder.glob("arrived-*")]
        assert list(folder.iterdir()) == ([got.folder] if got.sources else [])


@FUZZ
@given(damage=DAMAGE)
def test_broken_zips(native_zip: bytes, damage: tuple[list[tuple[float, int]], float]) -> None:
    receive("walk.zip", damaged(native_zip, damage))


@FUZZ
@given(
    head=st.sampled_from(
        [
            *(b"", b"PK\x03\x04", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*"),
            *(b"{", b"\x93NUMPY\x01\0", b"\x93NUMPY\x02\0", b"RIFF\0\0\0\0WEBPVP8 "),
        ]
    ),
    rest=st.binary(max_size=300),
    name=st.text(max_size=40),
)
def test_anything_at_all(head: bytes, rest: bytes, name: str) -> None:
    receive(name, head + rest)


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<u2', 'fortran_order': False, 'shape': (9999999, 9999999)}",
        b"{'descr': '<u2', 'fortran_order': False, 'shape': (-4, 2)}",
        b"{'descr': '|V100000', 'fortran_order': False, 'shape': (2, 2)}",
        b"{'descr': [('a', '<u2')], 'fortran_order': False, 'shape': (2, 2)}",
        b"{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1,)}",
        b"(" * 3000,
        b"{'descr': __import__('os'), 'fortran_order': False, 'shape': ()}",
    ],
)
def test_array_heads_that_were_built_to_harm(header: bytes) -> None:
    data = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header + bytes(8)
    receive("depth_1.npy", data)
