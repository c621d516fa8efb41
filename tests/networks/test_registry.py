from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cucumbervision.cli.models import app
from cucumbervision.errors import ModelError, ModelHashError
from cucumbervision.networks.find import NetworkLoader, open_segmenter
from cucumbervision.networks.registry import (
    IN_USE,
    JUDGEMENT,
    Registry,
    file_sha256,
    load_registry,
    models_folder,
    use_network,
    use_shipped,
)
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


SHIPPED = load_registry(user=Path("/nowhere"))
DETECTOR = SHIPPED.resolve("cucumber-seg")["network"]
SHA256 = file_sha256(DETECTOR)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of fetched models, empty."""
    monkeypatch.setenv("CUCUMBERVISION_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


def make_run(tmp_path: Path, name: str = "house-seg", **judgement: Any) -> Path:
    """A run's folder with a real detector and what was said of it."""
    run = tmp_path / name
    run.mkdir()
    shutil.copyfile(DETECTOR, run / f"{name}.onnx")
    values = {"file": f"{name}.onnx", "new": SHA256, "old": SHA256, "better": True, "why": "it is"}
    (run / JUDGEMENT).write_text(json.dumps({**values, **judgement}))
    return run


def in_use() -> str:
    found = load_registry().default("segment")
    assert found is not None
    return found.name


def test_a_better_network_takes_the_place_of_the_shipped_one_and_gives_it_back(
    folder: Path, tmp_path: Path
) -> None:
    model = use_network(make_run(tmp_path))
    assert in_use() == model.name == f"house-seg-{SHA256[:8]}"
    loader = NetworkLoader()
    assert loader.detectors().labels == ("cucumber",)
    assert next((one["name"], one["sha256"]) for one in loader.models) == (model.name, SHA256)
    assert load_registry().resolve(model.name)["network"].is_relative_to(folder)
    use_shipped()
    assert in_use() == "cucumber-seg"


def test_the_newest_is_used_and_shipped_leads_to_the_package(folder: Path, tmp_path: Path) -> None:
    first = use_network(make_run(tmp_path, "first"))
    second = use_network(make_run(tmp_path, "second"))
    assert in_use() == second.name
    again = use_network(tmp_path / "first")
    assert in_use() == again.name == first.name
    assert len(load_registry().user_models) == 2  # no second place in the list
    use_shipped()
    assert in_use() == "cucumber-seg"
    assert json.loads((folder / IN_USE).read_text()) == {"models": []}


@pytest.mark.parametrize(
    ("judgement", "fault"),
    [
        ({"better": False, "why": "on drawn F1 falls"}, "is not better: on drawn F1 falls"),
        ({"old": "0" * 64}, "judged against another network"),
        ({"new": "0" * 64}, "it was not compared"),
    ],
)
def test_what_is_not_known_to_be_better_is_refused_but_can_be_forced(
    judgement: dict[str, Any], fault: str, folder: Path, tmp_path: Path
) -> None:
    run = make_run(tmp_path, **judgement)
    with pytest.raises(ModelError, match=fault):
        use_network(run)
    assert not folder.exists()
    use_network(run, anyway=True)
    assert in_use().startswith("house-seg-")


def test_a_bare_file_must_be_a_network_and_forced(folder: Path, tmp_path: Path) -> None:
    path = Path(shutil.copyfile(DETECTOR, tmp_path / "mine.onnx"))
    with pytest.raises(ModelError, match="it was not compared"):
        use_network(path)
    assert use_network(path, anyway=True).task == "segment"
    (tmp_path / "text.onnx").write_text("no network")
    for given in (tmp_path / "text.onnx", tmp_path / "missing.onnx", tmp_path):
        with pytest.raises(ModelError):
            use_network(given, anyway=True)


def test_a_pose_network_of_ones_own_replaces_the_look_at_each_fruit(
    folder: Path, tmp_path: Path
) -> None:
    assert tasks_of(NetworkLoader()) == {"segment", "fruit"}
    path = shutil.copyfile(SHIPPED.resolve("cucumber-pose")["network"], tmp_path / "mine.onnx")
    use_network(Path(path), anyway=True)
    loader = NetworkLoader()
    assert tasks_of(loader) == {"segment", "pose"}
    # Its points are ordered by place: the look tells the stem end.
    assert loader.stem_looker() is not None
    assert {model["task"] for model in loader.models} == {"segment", "pose", "fruit"}


def tasks_of(loader: NetworkLoader) -> set[str]:
    """Return the tasks of the networks that find fruit."""
    loader.detectors()
    return {model["task"] for model in loader.models}


def test_a_broken_list_and_a_missing_file_are_named(folder: Path, tmp_path: Path) -> None:
    model = use_network(make_run(tmp_path))
    shutil.rmtree(folder / model.name)
    with pytest.raises(ModelError, match="models use --shipped"):
        load_registry().resolve(model.name)
    for text in ("{", "[]", '{"models": [{"name": "mine"}]}'):
        (folder / IN_USE).write_text(text)
        with pytest.raises(ModelError, match=IN_USE):
            load_registry()


def test_the_command_switches_and_lists(folder: Path, tmp_path: Path) -> None:
    run, runner = make_run(tmp_path), CliRunner()
    assert f"In use now: house-seg-{SHA256[:8]}" in runner.invoke(app, ["use", str(run)]).output
    assert "in use" in runner.invoke(app, ["list"]).output
    assert "In use now: the package's own" in runner.invoke(app, ["use", "--shipped"]).output
    for words in (["use"], ["use", str(run), "--shipped"]):
        assert isinstance(runner.invoke(app, words).exception, ModelError)


def test_a_graph_that_would_crash_openvino_is_refused(folder: Path, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(DETECTOR)
    conv = next(node for node in model.graph.node if node.op_type == "Conv")
    conv.input[:] = [""]  # it has no inputs any more
    onnx.save(model, tmp_path / "mine.onnx")
    with pytest.raises(ModelError, match="ONNX Runtime cannot load it"):
        use_network(tmp_path / "mine.onnx", anyway=True)
