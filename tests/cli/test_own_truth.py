from __future__ import annotations

import csv
import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.capture.source import example_captures
from cucumbervision.methods.result import MethodName
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run by the paper's methods, and hand lengths of a camera that reads a fifth too short."""
    folder = tmp_path_factory.mktemp("truth")
    options = MeasureOptions(methods=(MethodName.M3, MethodName.M5))
    assert measure_inputs([example_captures()], folder / "run", options).failures == []
    with (folder / "truth.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream)
        table.writerow(["capture", "fruit", "length_1_cm", "length_2_cm", "kind", "specimen"])
        for capture in sorted(example_captures().iterdir()):
            for k, true in enumerate(json.loads((capture / "truth.json").read_text()), 1):
                tape = 125 * true["centreline_m"]
                row = [capture.name, k, f"{tape - 0.05:.2f}", f"{tape + 0.05:.2f}", "centreline"]
                table.writerow([*row, f"{capture.name} {k}"])
    return folder


def test_evaluate_prints_a_table_and_writes_files(run: Run, folder: Path, tmp_path: Path) -> None:
    done = run("evaluate", "lengths", folder / "run", folder / "truth.csv", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Errors against hand-measured lengths" in done.stdout
    # Two measurements 1 mm apart: a standard deviation of 0.71 mm, rounded to 0.1 mm.
    assert "a standard deviation of 0.7" in done.stdout
    assert "16 measurements of 8 fruit" in done.stdout
    assert "Some of these captures are simulated" in done.stdout
    files = {path.name for path in tmp_path.iterdir()}
    assert {"scores.csv", "lengths.csv", "agreement.csv"} <= files
    assert "Agreement with hand-measured lengths" in done.stdout
    with (tmp_path / "scores.csv").open(encoding="utf-8-sig", newline="") as stream:
        m5 = next(score for score in csv.DictReader(stream) if score["method"] == "M5")
    assert (m5["kind"], m5["fruit"], m5["measured"]) == ("centreline", "8", "1.0")
    low, mape, high = (float(m5[f"{name}_percent"]) for name in ("low", "mape", "high"))
    assert low < mape < high


def rows_of(out: Path) -> list[dict[str, Any]]:
    report = json.loads((out / "measurements.json").read_text())
    return [fruit for capture in report["captures"] for fruit in capture["fruit"]]


def test_calibrate_and_measure_with_it(run: Run, folder: Path, tmp_path: Path) -> None:
    site = tmp_path / "house-3.json"
    done = run("calibrate", folder / "run", folder / "truth.csv", "--out", site)
    assert done.returncode == 0, done.stderr
    assert "scale+offset needs 10 fruit, there are 8" in done.stdout
    assert "90 % needs 9 fruit, there are 8" in done.stdout
    arguments = ("--methods", "m3,m5", "--calibration", site)
    run("measure", example_captures(), "--out", tmp_path / "out", *arguments)
    rows = rows_of(tmp_path / "out")
    scale = next(
        e["scale"] for e in json.loads(site.read_text())["corrections"] if e["method"] == "M5"
    )
    for row in rows:
        assert row["calibration"].startswith("house-3@")
        assert row["length_cm"] == pytest.approx(scale * row["m5_cm"], abs=2e-3)
        assert (row["raw_length_cm"], row["raw_length_kind"]) == (row["m5_cm"], "surface-arc")
        assert row["length_kind"] == "centreline"
        assert row["interval_basis"] is None
    run("measure", example_captures(), "--out", tmp_path / "m1", "--methods", "m1",
        "--calibration", site)  # fmt: skip
    for row in rows_of(tmp_path / "m1"):
        # Drawn fruit are slanted, and M1's own interval then says nothing.
        assert set(row["flags"].split()) - {"interval-too-wide"} == {"calibration-not-covered"}


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("calibrate", "{run}", "--out", "{tmp}/a.json"), "nothing to calibrate with"),
        (("calibrate", "{tmp}", "{truth}", "--out", "{tmp}/a.json"), "measurements.json"),
        (("calibrate", "{run}", "--grid", "10", "--out", "{tmp}/a.json"), "no captures that"),
        (("evaluate", "lengths", "{run}", "{tmp}/no.csv", "--out", "{tmp}"), "no.csv: cannot be"),
        (
            ("measure", "{run}", "--out", "{tmp}/o", "--calibration", "{tmp}/no.json"),
            "no.json: the file is missing",
        ),
    ],
)
def test_what_cannot_be_done_is_one_line_and_exit_code_2(
    run: Run, folder: Path, tmp_path: Path, arguments: tuple[str, ...], text: str
) -> None:
    places = {"run": folder / "run", "truth": folder / "truth.csv", "tmp": tmp_path}
    done = run(*(argument.format(**places) for argument in arguments))
    assert done.returncode == 2
    assert text in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "a.json").exists()
