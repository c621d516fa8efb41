from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.errors import ModelError, ModelHashError
from cucumbervision.networks.find import open_segmenter
from cucumbervision.networks.registry import Registry, load_registry, models_folder
from cucumbervision.networks.runtime import open_network

# SHA-256 of b"abc", from FIPS 180-2, appendix B.1.
ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
ENTRIES = f"""
[[models]]
name = "inside"
task = "segment"
licence = "AGPL-3.0-only"
title = "Found in the package"
origin = "this project"
embedded = true
card = "docs/cards/inside.md"
files = [{{ role = "network", file = "inside.onnx", sha256 = "{ABC}", size_bytes = 3 }}]

[[models]]
name = "outside"
task = "prompted-mask"
licence = "Apache-2.0"
title = "The user's"
origin = "somebody"
files = [{{ role = "encoder", file = "e.onnx" }}, {{ role = "decoder", file = "d.onnx" }}]
"""


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "inside.onnx").write_bytes(b"abc")
    (tmp_path / "models.toml").write_text(ENTRIES)
    return load_registry(tmp_path / "models.toml", user=tmp_path / "user")


def test_the_packages_own_registry_is_sound() -> None:
    registry = load_registry()
    assert "mobile-sam" in {m.name for m in registry.models}
    for model in registry.models:
        assert model.licence
        assert model.title
        assert model.origin
        # A network is somebody's, or our own, with a card.
        assert (model.task != "prompted-mask") == bool(model.card)
        if model.embedded:
            sizes = {f.file: f.size_bytes for f in model.files}
            paths = registry.resolve(model.name).values()
            assert {p.name: p.stat().st_size for p in paths} == sizes


def test_embedded_weights_come_with_licence_and_provenance() -> None:
    registry = load_registry()
    notice = (registry.embedded / "NOTICE.md").read_text()
    assert "Apache License" in (registry.embedded / "LICENSE-APACHE-2.0.txt").read_text()
    for path in registry.resolve("mobile-sam").values():
        metadata = open_network(path, "onnxruntime").metadata
        assert metadata["source_sha256"] in notice
        assert metadata["licence"] == "Apache-2.0"


def test_a_changed_byte_is_found(registry: Registry, tmp_path: Path) -> None:
    path = tmp_path / "weights" / "inside.onnx"
    path.write_bytes(b"abd")
    with pytest.raises(ModelHashError, match=r"inside\.onnx: .*; install cucumbervision again"):
        registry.resolve("inside")


def test_a_missing_file_is_told(registry: Registry, tmp_path: Path) -> None:
    (tmp_path / "weights" / "inside.onnx").unlink()
    with pytest.raises(ModelError, match=r"inside\.onnx: the file is missing"):
        registry.resolve("inside")


@pytest.mark.parametrize("content", ["models = 3", "[[models]]\nname = 'x'", "[["])
def test_a_broken_registry_is_told(tmp_path: Path, content: str) -> None:
    (tmp_path / "models.toml").write_text(content)
    with pytest.raises(ModelError, match=r"models\.toml: .*; install again"):
        load_registry(tmp_path / "models.toml")


def test_the_variable_moves_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUCUMBERVISION_MODELS", str(tmp_path))
    assert models_folder() == tmp_path
    assert load_registry().user == tmp_path
    monkeypatch.delenv("CUCUMBERVISION_MODELS")
    assert models_folder().parts[-2:] == ("cucumbervision", "models")


class ByColour:
    def __init__(self, files: dict[str, Path], runtime: str, prompt: str, **_: object) -> None:
        self.files, self.runtime, self.prompt = files, runtime, prompt


def test_a_segmenter_without_weights_needs_no_files(tmp_path: Path) -> None:
    entry = """
[[models]]
name = "by-colour"
task = "prompted-mask"
segmenter = "tests.networks.test_registry:ByColour"
licence = "MIT"
title = "No weights"
origin = "somebody"
embedded = true
"""
    (tmp_path / "models.toml").write_text(entry)
    registry = load_registry(tmp_path / "models.toml", user=tmp_path / "user")
    opened = open_segmenter("by-colour", prompt="box", registry=registry)
    assert isinstance(opened, ByColour)
    assert (opened.files, opened.prompt) == ({}, "box")
