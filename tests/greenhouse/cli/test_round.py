from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.capsules import capsule_capture, lying
from typer.testing import CliRunner

from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures
from cucumbervision.cli.app import app
from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.store.records import CaptureRecord, StopRecord, new_key
from cucumbervision_greenhouse.store.repository import open_store


def run(*arguments: str) -> str:
    done = CliRunner().invoke(app, ["round", *arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture
def house(tmp_path: Path) -> list[str]:
    """A store with a round."""
    store = ["--store", str(tmp_path / "house.db")]
    run("new", "morning", "--house", "1", *store)
    return store


def test_a_round_from_captures_to_its_fruit(house: list[str]) -> None:
    rows = [str(example_captures() / f"simulated-row-{name}") for name in "ab"]
    where = ("--row", "4", "--side", "left", "--position", "2", "--spacing", "3")
    said = run("add", *rows, *where, "--instances", "dataset", *house)
    assert "2 stops added" in said
    again = run("add", *rows, *where, "--instances", "dataset", *house)
    assert "0 stops added with 0 fruit; 2 were there already." in again
    assert "morning" in run("list", *house)
    assert "stops known to" in run("merge", *house)
    table = run("show", *house)
    assert "morning" in table
    assert "2.0" in table
    with open_store(house[1]) as store:
        key = store.rounds()[0].key
        store.pick([store.detections(key)[0].key])
    assert "picked" in run("show", *house)


def test_captures_that_two_runs_add_at_once_are_stored_once(
    house: list[str], tmp_path: Path
) -> None:
    capture = capsule_capture(lying(0.16))  # without a time: each run reads its file's
    folders = [tmp_path / f"stop-{k}" for k in range(2)]
    for k, folder in enumerate(folders):
        write_native(replace(capture, name=f"stop-{k}"), folder)
    where = ("--row", "4", "--side", "left", "--position", "2", "--spacing", "3")
    command = [sys.executable, "-c", "from cucumbervision.cli.app import main; main()"]
    command += ["round", "add", *map(str, folders), *where, "--instances", "dataset", *house]
    runs = [subprocess.Popen(command, stdout=-1, stderr=-2, text=True) for _ in range(3)]
    said = [run.communicate(timeout=300)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0, 0], said
    with open_store(house[1]) as store:
        (walk,) = store.rounds()
        assert walk.stops == 2
        assert len(store.detections(walk.key)) == 2


def test_what_the_data_make_doubtful_is_said_with_the_remedy(
    house: list[str], tmp_path: Path
) -> None:
    capture = capsule_capture(lying(0.16))
    inverse = replace(capture, depth_m=(0.2 / capture.depth_m).astype(np.float32))
    write_native(inverse, tmp_path / "in" / "inverse")
    where = ("--row", "1", "--side", "left", "--position", "1", "--instances", "dataset")
    printed = run("add", str(tmp_path / "in"), *where, *house)
    assert "Check the data of this round: 1 of 1 fruit: the depth of their middle" in printed
    assert "and not their inverse or relative depth" in printed


def test_a_pair_without_intrinsics_gets_them_by_the_option(
    house: list[str], tmp_path: Path
) -> None:
    native = example_captures() / "simulated-row-a"
    pair = tmp_path / "pair"
    pair.mkdir()
    shutil.copy(native / "color_000000.jpg", pair / "rgb_1.jpg")
    shutil.copy(native / "depth_000000.png", pair / "depth_1.png")
    with pytest.raises(AssertionError, match="carries no camera intrinsics"):
        run("add", str(pair), *house)
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps(json.loads((native / "capture.json").read_text())["camera"]))
    assert "1 stops added" in run("add", str(pair), "--intrinsics", str(camera), *house)


def test_a_round_is_measured_again_on_demand(house: list[str]) -> None:
    row = (str(example_captures() / "simulated-row-a"), "--instances", "dataset")
    run("add", *row, *house)
    again = run("remeasure", "--instances", "dataset", *house)
    assert "1 stops measured again; the new round is " in again
    assert run("list", *house).count("morning") == 1


def test_lines_of_a_pose_file_without_a_capture_are_named(house: list[str], tmp_path: Path) -> None:
    poses = tmp_path / "poses.csv"
    poses.write_text("capture,position_m\nsimulated-row-a,0.4\nb7,0.8\n")
    row = (str(example_captures() / "simulated-row-a"), "--instances", "dataset")
    said = run("add", *row, "--poses", str(poses), "--workers", "2", *house)
    assert "1 stops added" in said
    assert "no capture is called b7" in said


def test_a_store_is_checked(house: list[str]) -> None:
    with open_store(house[1]) as store:
        thumbnail = store.images.put_thumbnail(np.full((48, 64, 3), 90, np.uint8))
        captures = (CaptureRecord("a", thumbnail=thumbnail),)
        walk = store.rounds()[0].key
        store.save_stop(StopRecord(key=new_key(), round_key=walk, captures=captures))
        path = store.images.path(thumbnail)
    assert "1 pictures, 0 files that no stop names\nsound" in run("check", *house)
    path.write_bytes(b"broken")
    done = CliRunner().invoke(app, ["round", "check", *house])
    assert done.exit_code == 1
    assert f"damaged: {path}" in done.stdout


def test_faults_are_named(house: list[str]) -> None:
    with pytest.raises(CucumberVisionError, match="no round is called 'evening'"):
        run("show", "--round", "evening", *house)


@pytest.mark.parametrize(
    "command", ["list", "show", "merge", "check", "add x", "link monday", "remeasure"]
)
def test_a_store_that_is_not_there_is_not_made(tmp_path: Path, command: str) -> None:
    store = tmp_path / "houses" / "hause.db"
    with pytest.raises(CucumberVisionError, match="is not there; check the path"):
        run(*command.split(), "--store", str(store))
    assert not any(tmp_path.iterdir())


def test_names_are_printed_letter_by_letter(tmp_path: Path) -> None:
    name = "[/x] [red]a[/red] :tada:"
    store = ["--store", str(tmp_path / "house.db")]
    run("new", name, "--house", name, *store)
    run("add", str(example_captures() / "simulated-row-a"), "--row", name, *store)

    def letters(said: str) -> str:  # cells are folded
        return "".join(c for c in said if not c.isspace() and c not in "│┃")

    assert letters(run("list", *store)).count(letters(name)) >= 1
    for command in ("merge", "show"):
        assert letters("[/x]") in letters(run(command, *store))
