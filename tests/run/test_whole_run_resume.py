"""A run that is started again: what it measures anew, what it takes over, what it keeps."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.capture.source import ReadOptions, example_captures
from cucumbervision.methods.result import MethodName
from cucumbervision.run.measurer import Failure
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import BatchOptions, CaptureRecord, RunResult, measure_inputs

NAMES = ("simulated-bench", "simulated-row-a", "simulated-row-b")
OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M1,))
TABLES = ("measurements.csv", "failures.csv")


@pytest.fixture
def house(tmp_path: Path) -> Path:
    return Path(shutil.copytree(example_captures(), tmp_path / "house"))


class Watched:
    """Runs over one house into one folder, and which captures each run measured."""

    def __init__(self, house: Path) -> None:
        self.house, self.out = house, house.parent / "out"
        self.measured: list[str] = []

    def __call__(
        self, options: MeasureOptions = OPTIONS, batch: BatchOptions | None = None, *inputs: Path
    ) -> RunResult:
        self.measured.clear()
        return measure_inputs(inputs or [self.house], self.out, options, self._note, batch)

    def _note(self, done: CaptureRecord | Failure) -> None:
        if isinstance(done, CaptureRecord) and not done.is_earlier:
            self.measured.append(done.capture["name"])

    def tables(self) -> list[bytes]:
        return [(self.out / name).read_bytes() for name in TABLES]


@pytest.fixture
def run(house: Path) -> Watched:
    return Watched(house)


def test_a_second_run_measures_nothing_and_writes_the_same(run: Watched) -> None:
    first, tables = run(), run.tables()
    assert tuple(run.measured) == NAMES
    second = run()
    assert run.measured == []
    assert run.tables() == tables
    assert (second.before, second.captures, second.rows) == (3, 3, first.rows)


def test_stopped_after_the_first_and_started_again_is_the_same_as_never_stopped(
    run: Watched,
) -> None:
    run()
    whole = run.tables()
    shutil.rmtree(run.out)
    stopped = run(OPTIONS, BatchOptions(is_cancelled=lambda: bool(run.measured)))
    # The second had begun; two are measured at once.
    assert tuple(run.measured) == NAMES[:2]
    assert (stopped.interrupted, stopped.exit_code, stopped.captures) == (True, 130, 2)
    lines = (run.out / "measurements.csv").read_text(encoding="utf-8-sig").splitlines()
    assert len(lines) == 1 + len(stopped.rows) == 7
    assert len(json.loads((run.out / "measurements.json").read_text())["captures"]) == 2
    assert (run.out / "measurements.xlsx").exists()
    assert not run().interrupted
    assert tuple(run.measured) == NAMES[2:]
    assert run.tables() == whole


def test_a_run_stopped_at_once_keeps_what_earlier_runs_measured(run: Watched) -> None:
    run()
    whole = run.tables()
    again = run(OPTIONS, BatchOptions(is_cancelled=lambda: True))
    assert (run.measured, again.interrupted) == ([], False)
    assert run.tables() == whole


def test_a_damaged_record_costs_its_own_capture(run: Watched) -> None:
    run()
    whole, record = run.tables(), run.out / "records" / f"{NAMES[1]}.json"
    record.write_bytes(record.read_bytes()[:-20])
    run()
    assert run.measured == [NAMES[1]]
    assert run.tables() == whole


def test_a_run_that_read_nothing_leaves_the_tables(run: Watched) -> None:
    run()
    whole = run.tables()
    result = run(OPTIONS, None, run.house.parent / "hose")
    assert (result.exit_code, result.captures) == (2, 0)
    assert any("nothing was read" in note for note in result.notes)
    assert run.tables() == whole


def test_results_inside_the_input_are_no_captures(run: Watched) -> None:
    run.out = run.house / "results"
    run()
    whole = run.tables()
    assert run().exit_code == 0
    assert run.tables() == whole
    assert run.measured == []


def test_only_a_changed_capture_is_measured_again(run: Watched) -> None:
    run()
    mask = run.house / NAMES[1] / "mask_visib" / "000000_000000.png"
    mask.unlink()
    result = run()
    assert run.measured == [NAMES[1]]
    assert sum(row["capture"] == NAMES[1] for row in result.rows) == 2


def test_a_picture_that_is_gone_is_drawn_again(run: Watched) -> None:
    run()
    picture = run.out / "overlays" / f"{NAMES[2]}.png"
    picture.unlink()
    run()
    assert run.measured == [NAMES[2]]
    assert picture.exists()


def test_a_picture_of_another_kind_is_drawn_and_none_is_not_missed(run: Watched) -> None:
    run()
    run(OPTIONS, BatchOptions(overlays="jpg"))
    assert run.measured == list(NAMES)
    assert (run.out / "overlays" / f"{NAMES[2]}.jpg").read_bytes().startswith(b"\xff\xd8")
    for path in (run.out / "overlays").iterdir():
        path.unlink()
    run(OPTIONS, BatchOptions(overlays="none"))
    assert run.measured == []
    run(replace(OPTIONS, methods=(MethodName.M3,)), BatchOptions(overlays="none"))
    run(replace(OPTIONS, methods=(MethodName.M3,)), BatchOptions(overlays="none"))
    assert run.measured == []
    assert not list((run.out / "overlays").iterdir())


def test_a_changed_file_of_boxes_is_seen(run: Watched) -> None:
    boxes = run.house.parent / f"{NAMES[1]}.txt"
    options = replace(OPTIONS, instances=str(boxes), segmenter="none")
    line = f"0 {220 / 848} {232 / 480} {80 / 848} {295 / 480}\n"
    boxes.write_text(line)
    path = run.house / NAMES[1]
    run(options, None, path)
    run(options, None, path)
    assert run.measured == []
    boxes.write_text(line * 2)
    run(options, None, path)
    assert run.measured == [NAMES[1]]


def test_a_capture_that_failed_is_tried_again(run: Watched) -> None:
    depth = next((run.house / NAMES[0]).glob("depth_*.png"))
    whole = depth.read_bytes()
    depth.write_bytes(whole[:100])
    assert run().exit_code == 1
    depth.write_bytes(whole)
    assert run().exit_code == 0
    assert run.measured == [NAMES[0]]


def test_the_same_path_twice_is_measured_once_and_said(run: Watched) -> None:
    inner = run.house / NAMES[1]
    result = run(OPTIONS, None, run.house, run.house / ".", inner)
    assert tuple(run.measured) == NAMES
    assert len({(row["capture"], row["fruit"]) for row in result.rows}) == len(result.rows) == 8
    assert result.notes == [
        f"{run.house} is given twice: it is measured once",
        f"{inner}: 1 capture was given before, and measured once",
    ]


def test_json_is_written_as_one_value_a_line(run: Watched) -> None:
    run()
    text = (run.out / "measurements.json").read_text(encoding="utf-8")
    assert text == json.dumps(json.loads(text), indent=1, ensure_ascii=False) + "\n"


def test_ctrl_c_ends_after_the_running_captures(tmp_path: Path) -> None:
    # The signal comes while the first capture is measured, and the second searched.
    program = """
import os, signal
import cucumbervision.run.measurer as module
real = module.measure_fruit
def pressed(*arguments, **more):
    if getattr(signal.getsignal(signal.SIGINT), "__name__", "") == "press":
        os.kill(os.getpid(), signal.SIGINT)
    return real(*arguments, **more)
module.measure_fruit = pressed
from cucumbervision.cli.app import main; main()
"""
    arguments = ["measure", str(example_captures()), "--out", str(tmp_path), "--methods", "m1"]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"COLUMNS": "120"},
    )
    assert done.returncode == 130
    assert "rerun the command to resume" in done.stderr
    report = json.loads((tmp_path / "measurements.json").read_text())
    assert tuple(capture["name"] for capture in report["captures"]) == NAMES[:2]


def test_other_code_is_seen(run: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    # As by an update of the software, whatever version it has.
    monkeypatch.setattr("cucumbervision.run.whole_run.code_sha256", lambda: "older")
    run()
    monkeypatch.undo()
    run()
    assert tuple(run.measured) == NAMES


def test_a_changed_file_of_intrinsics_is_seen(run: Watched) -> None:
    path = run.house / NAMES[0]
    camera = json.loads((path / "capture.json").read_text())["camera"]
    given = run.house.parent / "camera.json"
    given.write_text(json.dumps(camera))
    options = replace(OPTIONS, reading=ReadOptions(given))
    first = run(options, None, path).summary
    run(options, None, path)
    assert run.measured == []
    camera |= {"fx": 0.99 * camera["fx"], "fy": 0.99 * camera["fy"]}
    given.write_text(json.dumps(camera))
    again = run(options, None, path).summary
    assert run.measured == [NAMES[0]]
    longer = [length_cm / 0.99 for length_cm in first.lengths_cm]
    assert list(again.lengths_cm) == pytest.approx(longer, rel=1e-3)
