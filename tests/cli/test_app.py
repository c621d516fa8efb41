from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cucumbervision.capture.source import example_captures

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_measure_writes_its_files_and_shows_a_table(run: Run, tmp_path: Path) -> None:
    done = run("measure", str(example_captures()), "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert (
        "8 of 8 fruit measured in 3 captures; masks by data set 8; some of these captures"
        in done.stdout
    )
    assert "centreline" in done.stdout
    names = {p.name for p in tmp_path.iterdir()}
    tables = {"measurements.csv", "measurements.xlsx", "measurements.json", "failures.csv"}
    assert names == {*tables, "overlays", "records", ".lock"}


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--instances", "nowhere.onnx"), "nowhere.onnx: no such file"),
        (("--methods", "m7"), "'m7' is not a valid value; give M1 or"),
    ],
)
def test_what_cannot_start_is_exit_code_2_in_plain_words(
    run: Run, tmp_path: Path, arguments: tuple[str, ...], text: str
) -> None:
    done = run("measure", str(example_captures()), "--out", str(tmp_path), *arguments)
    assert done.returncode == 2
    assert text in done.stderr
    assert "Traceback" not in done.stderr


def test_quiet_mode_prints_nothing(run: Run, tmp_path: Path) -> None:
    done = run("measure", str(example_captures()), "--out", str(tmp_path), "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_paper_selector_and_chosen_methods(run: Run, tmp_path: Path) -> None:
    words = ("--out", str(tmp_path), "--selector", "paper", "--methods", "m1,m3")
    run("measure", str(example_captures()), *words)
    report = json.loads((tmp_path / "measurements.json").read_text())
    rows = [fruit for capture in report["captures"] for fruit in capture["fruit"]]
    assert {row["method"] for row in rows} == {"M3"}
    assert all(row["m5_cm"] is None and row["m1_cm"] for row in rows)


def test_demo_measures_the_bundled_captures_on_masks_that_fit(run: Run, tmp_path: Path) -> None:
    done = run("demo", "--out", str(tmp_path / "demo"))
    assert done.returncode == 0, done.stderr
    assert "8 of 8 fruit measured in 3 captures" in done.stdout
    report = json.loads((tmp_path / "demo" / "measurements.json").read_text())
    assert report["models"][0]["task"] == "segment"


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "sys.argv = ['cucumbervision', '--help']\n"
        "from cucumbervision.cli.app import app\n"
        "try:\n"
        "    app()\n"
        "except SystemExit:\n"
        "    pass\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'onnxruntime', 'openvino', 'torch', 'pydantic'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip().endswith("[]")


def test_version(run: Run) -> None:
    said = run("--version").stdout
    assert said.startswith("cucumbervision 0.")
    assert said.endswith((" (kernel: compiled)\n", " (kernel: numpy)\n"))
