from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

pytest.importorskip("torch")

from cucumbervision.networks.registry import file_sha256
from cucumbervision_lab.train.classifier import ClassifierOptions, Trained, write_classifier_card


def test_the_card_says_how_the_network_was_made(tmp_path: Path) -> None:
    network = tmp_path / "look.onnx"
    network.write_bytes(b"a network")
    trained = Trained(network, "look", ("Learnt from halves.",), {"accuracy": 0.75, "x": math.nan})
    options = ClassifierOptions(3, seed=9)
    card = write_classifier_card(trained, "my-look", "weights/yolo26n.pt", options, ["Photos: A"])
    assert (card.sha256, card.size_bytes) == (file_sha256(network), 9)
    assert card.began_with == "yolo26n.pt"
    assert card.command.endswith(
        "train classifier look SETS --init yolo26n.pt --out DIR --epochs 3 --seed 9"
    )
    page = (tmp_path / "my-look.md").read_text()
    for words in ("Learnt from halves.", "Photos: A", "0.75", card.sha256, "YOLO26, AGPL-3.0"):
        assert words in page
    saved = json.loads((tmp_path / "my-look.json").read_text())
    assert (saved["task"], saved["metrics"]) == ("look", {"accuracy": 0.75})
