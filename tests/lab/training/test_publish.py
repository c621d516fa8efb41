from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.errors import ModelHashError, TrainingError
from cucumbervision.perception.registry import load_registry
from cucumbervision_lab.training.publish import (
    MOST_BYTES,
    ModelCard,
    card_markdown,
    publish,
    read_card,
    with_entry,
    write_card,
)

OTHER = """# Read this.

[[models]]
name = "other"
task = "pose"
licence = "MIT"
title = "Another"
origin = "Elsewhere"
embedded = true

[[models.files]]
role = "network"
file = "other.onnx"
sha256 = "00"
"""


def exported(folder: Path, content: bytes, name: str = "c-seg") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.onnx").write_bytes(content)
    sha256 = hashlib.sha256(content).hexdigest()
    write_card(
        ModelCard(
            name, "segment", f"{name}.onnx", sha256, len(content), "ab", data="# Data\n\nten"
        ),
        folder,
    )
    return folder


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "package"
    (folder / "weights").mkdir(parents=True)
    (folder / "models.toml").write_text(OTHER)
    return folder


def test_a_network_is_added_and_then_replaced(tmp_path: Path, package: Path) -> None:
    publish(exported(tmp_path / "a", b"first"), "c-seg", package)
    publish(exported(tmp_path / "b", b"second", "d-seg"), "d-seg", package)
    publish(exported(tmp_path / "c", b"third"), "c-seg", package)
    text = (package / "models.toml").read_text()
    assert text.startswith(OTHER)
    registry = load_registry(package / "models.toml", tmp_path / "user")
    assert [m.name for m in registry.models] == ["other", "c-seg", "d-seg"]
    assert registry.resolve("c-seg")["network"].read_bytes() == b"third"
    assert registry.resolve("d-seg")["network"].read_bytes() == b"second"
    model = registry.get("c-seg")
    assert (model.task, model.licence, model.embedded) == ("segment", "AGPL-3.0-only", True)
    assert (package / "weights" / model.card).read_text().startswith("# c-seg\n")
    assert registry.default("segment") == model


def test_the_packages_own_registry_keeps_its_text() -> None:
    path = Path(load_registry().embedded).parent / "models.toml"
    text = path.read_text()
    card = ModelCard("zz-new", "pose", "zz-new.onnx", "ab", 5, "cd")
    once = with_entry(text, card)
    assert once.startswith(text)
    assert with_entry(once, card) == once


def test_another_file_than_the_cards_is_refused(tmp_path: Path, package: Path) -> None:
    folder = exported(tmp_path / "a", b"first")
    (folder / "c-seg.onnx").write_bytes(b"forged")
    with pytest.raises(ModelHashError, match="does not match the hash in its card"):
        publish(folder, "c-seg", package)
    assert list((package / "weights").iterdir()) == []


def test_too_heavy_a_package_is_refused(tmp_path: Path, package: Path) -> None:
    with (package / "weights" / "other.onnx").open("wb") as file:
        file.truncate(MOST_BYTES - 3)
    with pytest.raises(TrainingError, match=r"would take 45\.0 MB in total; .* limit is 45 MB"):
        publish(exported(tmp_path / "a", b"four"), "c-seg", package)
    publish(exported(tmp_path / "a", b"abc"), "c-seg", package)
    assert (package / "models.toml").read_text() != OTHER


def test_cards_survive_the_disk(tmp_path: Path) -> None:
    card = read_card(exported(tmp_path / "a", b"first") / "c-seg.json")
    assert card.credits == ("Network and its first weights: Ultralytics YOLO26, AGPL-3.0",)
    assert card_markdown(card).endswith("## Data\n\nten\n")
    (tmp_path / "bad.json").write_text('{"name": "a"}')
    for name in ("bad.json", "none.json"):
        with pytest.raises(TrainingError, match="; export the network again"):
            read_card(tmp_path / name)


def test_what_could_not_be_judged_is_left_out_of_a_card(tmp_path: Path) -> None:
    card = read_card(exported(tmp_path / "a", b"first") / "c-seg.json")
    judged = replace(card, metrics={"sure": 0.0, "right of these": math.nan})
    page, record = write_card(judged, tmp_path)
    assert read_card(record).metrics == {"sure": 0.0}
    assert "right of these" not in page.read_text()


@pytest.mark.parametrize("size", [0, -1, 2**40, 10**400])
def test_a_card_whose_size_is_no_files_is_refused(size: int, tmp_path: Path) -> None:
    file = exported(tmp_path / "out", b"x") / "c-seg.json"
    file.write_text(file.read_text().replace('"size_bytes": 1,', f'"size_bytes": {size},'))
    with pytest.raises(TrainingError, match="size_bytes is out of range"):
        read_card(file)
