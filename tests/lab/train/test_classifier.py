"""A network of one layer learns which half of a picture is bright, and is exported."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if importlib.util.find_spec("ultralytics") is None:
    pytest.skip("needs the extra 'train'", allow_module_level=True)

from cucumbervision.networks.registry import file_sha256
from cucumbervision.networks.runtime import open_network
from cucumbervision_lab.train.classifier import (
    ClassifierOptions,
    Trained,
    export_network,
    fit,
    scaled_planes,
    write_classifier_card,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

pytestmark = pytest.mark.train

SIDE_PX = 16


def pictures(count: int, seed: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Noise whose right half is brighter where the target is 1, and the left where it is 0."""
    rng = np.random.default_rng(seed)
    target = rng.integers(0, 2, count).astype(np.float32)
    made = rng.integers(0, 100, (count, SIDE_PX, SIDE_PX, 3)).astype(np.uint8)
    for picture, is_right in zip(made, target, strict=True):
        half = np.s_[:, SIDE_PX // 2 :] if is_right else np.s_[:, : SIDE_PX // 2]
        picture[half] += 100
    return made, target


def make() -> Any:
    import torch

    flat = torch.nn.Flatten()
    line = torch.nn.Linear(3 * SIDE_PX * SIDE_PX, 1)
    return torch.nn.Sequential(flat, line, torch.nn.Flatten(0))


def learnt(data: tuple[NDArray[np.uint8], NDArray[np.float32]], options: ClassifierOptions) -> Any:
    import torch

    made, target = data

    def loss_of(network: Any, chosen: NDArray[np.intp]) -> Any:
        logits = network(scaled_planes(made[chosen]))
        return torch.nn.functional.binary_cross_entropy_with_logits(
            logits, torch.from_numpy(target[chosen])
        )

    return fit(make, len(made), loss_of, options)


def predict(network: Any, made: NDArray[np.uint8]) -> NDArray[np.float64]:
    import torch

    with torch.no_grad():
        return np.asarray(network(scaled_planes(made)).numpy(), np.float64)


def test_it_learns_what_the_targets_say() -> None:
    told: list[tuple[int, float]] = []
    options = ClassifierOptions(epochs=8, batch=16, progress=lambda *numbers: told.append(numbers))
    network = learnt(pictures(200, 1), options)
    fresh, target = pictures(100, 2)
    logits = predict(network, fresh)
    assert logits.shape == (100,)
    assert ((logits > 0) == (target > 0.5)).all()
    assert [number for number, _ in told] == list(range(1, 9))
    assert told[-1][1] < 0.2 * told[0][1]


def test_the_file_computes_what_the_network_does_for_any_number(tmp_path: Path) -> None:
    data, target = pictures(60, 5)
    options = ClassifierOptions(epochs=2, batch=16)
    network = learnt((data, target), options)
    path = tmp_path / "new" / "halves.onnx"
    example = {"pictures": scaled_planes(data[:2])}
    export_network(network, path, example, ("logits",), "fruit")
    opened = open_network(path, "onnxruntime", full_precision=True)
    assert opened.metadata["task"] == "fruit"
    for count in (1, 7):
        planes = data[:count].transpose(0, 3, 1, 2).astype(np.float32) / 255
        (logits,) = opened.run({"pictures": planes}).values()
        # Weights in half precision keep three digits.
        np.testing.assert_allclose(logits, predict(network, data[:count]), atol=0.02)


def trained(network: Path, **metrics: float) -> Trained:
    return Trained(network, "look", ("Learnt from halves.",), {**metrics, "accuracy": 0.75})


def test_the_card_says_how_the_network_was_made(tmp_path: Path) -> None:
    network = tmp_path / "look.onnx"
    network.write_bytes(b"a network")
    options = ClassifierOptions(3, seed=9)
    card = write_classifier_card(
        trained(network), "my-look", "weights/yolo26n.pt", options, ["Photos: A"]
    )
    assert (card.sha256, card.size_bytes) == (file_sha256(network), 9)
    assert card.began_with == "yolo26n.pt"
    assert card.command.endswith(
        "train classifier look SETS --init yolo26n.pt --out DIR --epochs 3 --seed 9"
    )
    page = (tmp_path / "my-look.md").read_text()
    for words in ("Learnt from halves.", "Photos: A", "0.75", card.sha256):
        assert words in page
    saved = json.loads((tmp_path / "my-look.json").read_text())
    assert (saved["task"], saved["metrics"]) == ("look", {"accuracy": 0.75})
