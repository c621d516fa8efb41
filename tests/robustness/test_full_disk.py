"""A full disk stops a batch by a named error; with room again the same command ends it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import copytree

import pytest

from cucumbervision.capture.source import example_captures

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
