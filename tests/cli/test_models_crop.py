"""`cucumbervision crop`, and a crop's folder given to `measure`."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

from typer.testing import CliRunner

from cucumbervision.capture.source import example_captures
from cucumbervision.cli.app import app
from cucumbervision.errors import ProfileError
from cucumbervision.networks import registry


def test_a_pack_is_made_checked_and_measured_with(tmp_path: Path) -> None:
    pack = tmp_path / "courgette"
    made = CliRunner().invoke(app, ["crop", "new", str(pack), "--like", "courgette"])
    assert made.exit_code == 0, made.output
    again = CliRunner().invoke(app, ["crop", "new", str(pack)])
    assert isinstance(again.exception, ProfileError)
    assert "is there already" in str(again.exception)
    network = registry.load_registry().resolve("cucumber-seg")["network"]
    shutil.copy(network, pack / "courgette-seg.onnx")
    shutil.copy(network.with_suffix(".json"), pack / "courgette-seg.json")
    (pack / "truth.csv").write_text("capture,fruit,length_cm,kind\nrow,1,18.2,chord\n")
    lines = CliRunner().invoke(app, ["crop", "check", str(pack)]).output.splitlines()
    assert lines == [
        "courgette: 3 to 50 cm",
        "fruit: courgette-seg.onnx, segment, with its card",
        "keypoints: the package's own network",
        "truth: 1 lengths measured by hand",
    ]
    words = ["measure", str(example_captures() / "simulated-row-a"), "--profile", str(pack)]
    words += ["--segmenter", "none", "--methods", "m3", "--out", str(tmp_path / "run")]
    found = CliRunner().invoke(app, words)
    assert found.exit_code == 0, found.output
    text = (tmp_path / "run/measurements.csv").read_text("utf-8-sig")
    rows = list(csv.DictReader(text.splitlines()))
    # The pack's network found them: the data set's own masks have a score of 1.
    assert len(rows) == 3
    assert all(float(row["score"]) < 1 for row in rows)
