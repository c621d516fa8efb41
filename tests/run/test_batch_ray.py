from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.capture.source import CaptureRef, example_captures
from cucumbervision.errors import CucumberVisionError, DiskFullError
from cucumbervision.methods.result import MethodName
from cucumbervision.run import whole_run as run
from cucumbervision.run.batch import Item, RayEngine
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import BatchOptions, FolderWorker, measure_inputs

pytest.importorskip("ray")

OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M1,))
# Ray's own threads and sockets are still open when its cluster has ended.
pytestmark = pytest.mark.filterwarnings("ignore")


def test_rows_are_those_of_one_process_in_the_same_order(tmp_path: Path) -> None:
    inputs = [example_captures(), tmp_path / "missing"]
    engine = RayEngine("local", 1)
    tables: list[list[bytes]] = []
    for batch in (BatchOptions(), BatchOptions(engine=engine)):
        out = tmp_path / f"out{len(tables)}"
        result = measure_inputs(inputs, out, OPTIONS, batch=batch)
        assert (result.captures, result.exit_code) == (3, 1)
        tables.append([(out / f"{n}.csv").read_bytes() for n in ("measurements", "failures")])
    assert tables[0] == tables[1]
    again = measure_inputs(inputs, out, OPTIONS, batch=BatchOptions(engine=engine))
    assert again.before == 3


def test_what_cannot_be_loaded_is_said(tmp_path: Path) -> None:
    options = MeasureOptions(instances="models", segmenter="none", pose=tmp_path / "no.onnx")
    with pytest.raises(CucumberVisionError, match=r"no\.onnx: "):
        measure_inputs(
            [example_captures()], tmp_path, options, batch=BatchOptions(engine=RayEngine())
        )


class KilledWorker(FolderWorker):
    """A worker whose process is killed by one capture, as by a full memory."""

    def __call__(self, item: Item) -> Any:
        """Measure a capture, unless it is this one."""
        if isinstance(item, CaptureRef) and item.name == "simulated-row-b":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(item)


def test_a_capture_that_kills_its_worker_is_a_failure_and_the_others_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "FolderWorker", KilledWorker)
    batch = BatchOptions(engine=RayEngine("local", 1))
    result = measure_inputs([example_captures()], tmp_path, OPTIONS, batch=batch)
    (failure,) = result.failures
    assert (failure.capture, result.captures) == ("simulated-row-b", 2)
    assert "killed twice" in failure.message


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1.5 MB: room for two of the three pictures."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1500k", "none", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no small file system can be mounted here")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=False)


def test_a_full_disk_is_named_and_with_room_the_batch_goes_on(
    small_disk: Path, tmp_path: Path
) -> None:
    whole = measure_inputs([example_captures()], tmp_path / "whole", OPTIONS)
    batch = BatchOptions(engine=RayEngine("local", 1))
    with pytest.raises(DiskFullError, match=r"simulated-.*No space left"):
        measure_inputs([example_captures()], small_disk / "out", OPTIONS, batch=batch)
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    again = measure_inputs([example_captures()], small_disk / "out", OPTIONS, batch=batch)
    assert (again.exit_code, again.captures) == (0, 3)
    assert 0 < again.before < 3
    assert again.rows == whole.rows
