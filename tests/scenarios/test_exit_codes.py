"""What goes wrong for real: what is lost, what is said, and the exit code."""

from __future__ import annotations

import csv
import json
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cucumbervision.capture.source import example_captures

BENCH = example_captures() / "simulated-bench"
QUICK = ("--instances", "dataset", "--methods", "m1")

Run = Callable[..., subprocess.CompletedProcess[str]]

# Plants a defect: the first capture's fruit cannot be measured.
DEFECT = """
import cucumbervision.run.measurer as module
real = module.measure_fruit
def broken(capture, *rest, **more):
    if capture.source.endswith("other"):
        return 1.0 / (capture.width - 848.0)
    return real(capture, *rest, **more)
module.measure_fruit = broken
"""


def measure(
    *arguments: object,
    limit: Callable[[], None] | None = None,
    before: str = "",
    encoding: str = "utf-8",
) -> subprocess.CompletedProcess[str]:
    command = ["measure", *map(str, arguments), *QUICK]
    program = f"{before}\nfrom cucumbervision.cli.app import main; main()"
    return subprocess.run(
        [sys.executable, "-c", program, *command],
        capture_output=True,
        encoding=encoding,
        check=False,
        preexec_fn=limit,
    )


def failures(out: Path) -> list[tuple[str, str]]:
    with (out / "failures.csv").open(newline="", encoding="utf-8-sig") as stream:
        return [(row["error"], row["message"]) for row in csv.DictReader(stream)]


def rows(out: Path) -> int:
    return len((out / "measurements.csv").read_text(encoding="utf-8-sig").splitlines()) - 1


def named(folder: Path, text: str) -> Path:
    """A capture whose manifest is that text."""
    shutil.copytree(BENCH, folder)
    (folder / "capture.json").write_text(text)
    return folder


def test_a_single_wrong_path_is_2(run: Run, tmp_path: Path) -> None:
    done = run("measure", "nowhere", *QUICK, "--out", tmp_path)
    assert done.returncode == 2
    assert "nowhere: does not exist" in done.stderr


def test_a_wrong_path_among_others_is_1(run: Run, tmp_path: Path) -> None:
    done = run("measure", "nowhere", BENCH, *QUICK, "--out", tmp_path)
    assert (done.returncode, rows(tmp_path)) == (1, 3)


def test_a_name_of_300_characters_loses_nothing(run: Run, tmp_path: Path) -> None:
    manifest = json.loads((BENCH / "capture.json").read_text())
    long = named(tmp_path / "long", json.dumps({**manifest, "name": "x" * 300}))
    done = run("measure", long, BENCH, *QUICK, "--out", tmp_path / "out")
    assert (done.returncode, rows(tmp_path / "out")) == (0, 6)
    pictures = [path.name for path in (tmp_path / "out").rglob("*.png")]
    assert len(pictures) == 2
    assert max(map(len, pictures)) < 256


# Room for nothing, and for the head of the table but for no row or picture.
@pytest.mark.parametrize("room_bytes", [0, 900])
def test_a_full_disk_is_2_and_no_traceback(tmp_path: Path, room_bytes: int) -> None:
    def little_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, room_bytes))

    done = measure(BENCH, "--out", tmp_path, limit=little_room)
    assert done.returncode == 2
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_console_that_lacks_letters_shows_question_marks(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = json.loads((BENCH / "capture.json").read_text())
    house = named(tmp_path / "黄瓜", json.dumps({**manifest, "name": "黄瓜"}))
    monkeypatch.setenv("PYTHONIOENCODING", "cp1252")
    done = measure(house, tmp_path / "没有", "--out", tmp_path / "out", encoding="cp1252")
    assert (done.returncode, rows(tmp_path / "out")) == (1, 3)
    assert "??" in done.stdout
    assert "??: does not exist" in done.stderr
    # JSON escapes letters that the console may lack.
    done = run("stream", house, "--instances", "dataset", "--segmenter", "none")
    assert {json.loads(line)["capture"] for line in done.stdout.splitlines()} == {"黄瓜"}


def test_an_error_without_a_name_is_a_defect_of_ours_and_70(tmp_path: Path) -> None:
    named(tmp_path / "other", (BENCH / "capture.json").read_text())
    done = measure(tmp_path / "other", BENCH, "--out", tmp_path / "out", before=DEFECT)
    assert (done.returncode, rows(tmp_path / "out")) == (70, 3)
    [(error, message)] = failures(tmp_path / "out")
    assert error == "InternalError"
    assert "other: ZeroDivisionError: float division by zero" in message
    assert "report" in message
    assert message in done.stderr


def test_a_defect_outside_of_captures_is_70_with_its_traceback(tmp_path: Path) -> None:
    before = "import cucumbervision.run.whole_run as run; del run.OutputFolder; "
    done = measure(BENCH, "--out", tmp_path, before=before)
    assert done.returncode == 70
    assert "Traceback" in done.stderr
    assert "NameError" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("command", [("measure",), ("detect",), ("demo",), ("round", "add")])
def test_help_names_the_codes(
    run: Run, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    done = run(*command, "--help")
    assert done.returncode == 0
    said = " ".join(done.stdout.replace("│", " ").split())
    assert "Exit codes: 0 " in said
    assert "70 a defect of the software" in said
