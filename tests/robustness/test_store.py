"""A damaged store is read, or refused by a named error: never an internal one."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cucumbervision.capture.source import example_captures

INTERNAL_ERROR = 70
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def house(tmp_path: Path, run: Run) -> Path:
    file = tmp_path / "valid" / "house.db"
    file.parent.mkdir()
    assert run("round", "new", "walk", "--store", file).returncode == 0
    source = example_captures() / "simulated-row-b"
    assert run("round", "add", source, "--store", file, "--instances", "dataset").returncode == 0
    return file


@settings(max_examples=40, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_damaged_store_is_read_or_refused(
    house: Path, tmp_path: Path, run: Run, data: st.DataObject
) -> None:
    folder = tmp_path / "damaged"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(house.parent, folder)
    file, content = folder / house.name, bytearray(house.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content) - 1))
        content[start : start + 8] = data.draw(st.binary(min_size=1, max_size=8))
    file.write_bytes(content[: data.draw(st.sampled_from([len(content), len(content) // 2]))])
    for words in (("check",), ("list",), ("show", "walk")):
        done = run("round", *words, "--store", file)
        assert done.returncode in (0, 1, 2), done.stderr
