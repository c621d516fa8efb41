"""A batch killed at any moment and begun again ends with the rows of one that nothing disturbed."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from shutil import copytree

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs

CAPTURES, KILLS = 12, 2
CHILD = """
import sys
from pathlib import Path
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs
options = MeasureOptions(instances="dataset", methods=("M1",))
measure_inputs([Path(sys.argv[1])], Path(sys.argv[2]), options, lambda step: print(flush=True))
"""


def write_captures(folder: Path) -> None:
    camera = Intrinsics(96, 64, 90.0, 90.0, 47.5, 31.5)
    for number in range(CAPTURES):
        mask = np.zeros((64, 96), bool)
        mask[10 : 30 + number, 40:52] = True
        depth_m = np.where(mask, 0.5 + 0.001 * number, 0.9).astype(np.float32)
        color = np.full((64, 96, 3), 60 + number, np.uint8)
        name = f"stop-{number:02d}"
        write_native(Capture(color, depth_m, camera, name, masks=(mask,)), folder / name)


def test_a_batch_killed_again_and_again_loses_and_doubles_nothing(tmp_path: Path) -> None:
    house, out, whole = tmp_path / "house", tmp_path / "out", tmp_path / "whole"
    write_captures(house)
    random, killed = Random(1), 0
    for _ in range(KILLS):
        words = [sys.executable, "-c", CHILD, str(house), str(out)]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            for _ in range(random.randint(1, 4)):
                child.stdout.readline()  # a capture is done
            time.sleep(random.uniform(0, 0.01))  # between two writes, or inside one
            child.kill()
        killed += child.returncode < 0
    assert killed
    options = MeasureOptions(instances="dataset", methods=("M1",))
    measure_inputs([house], out, options)
    measure_inputs([house], whole, options)
    for name in ("measurements.csv", "failures.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    for picture in (whole / "overlays").iterdir():
        assert (out / "overlays" / picture.name).read_bytes() == picture.read_bytes()


COMMAND = ("measure", "--instances", "dataset", "--segmenter", "none", "--methods", "M1,M2")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system in memory with room for less than a run."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=700k", "none", str(folder)]
    try:
        mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("no small file system can be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_with_room_again_the_same_command_has_all_rows(
    tmp_path: Path, disk: Path, run: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    for name in "abcdef":
        copytree(example_captures() / "simulated-row-b", tmp_path / "in" / name)
    assert run(*COMMAND, tmp_path / "in", "--out", tmp_path / "whole").returncode == 0
    full = run(*COMMAND, tmp_path / "in", "--out", disk / "out")
    assert full.returncode in (1, 2)
    assert "No space" in full.stdout + full.stderr
    subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
    assert run(*COMMAND, tmp_path / "in", "--out", disk / "out").returncode == 0
    whole = (tmp_path / "whole" / "measurements.csv").read_bytes()
    assert (disk / "out" / "measurements.csv").read_bytes() == whole


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
