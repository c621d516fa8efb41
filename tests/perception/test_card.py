"""No test has a card: ONNX Runtime's processor takes its place, with the same bindings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import ModelError
from cucumbervision.instances.instance import Instance
from cucumbervision.perception import onnx_runtime
from cucumbervision.perception.card import (
    Card,
    CardArray,
    Levels,
    engine_folder,
    provider_options,
)
from cucumbervision.perception.networks import NetworkLoader
from cucumbervision.perception.registry import load_registry
from cucumbervision.perception.runtime import open_network

DETECTOR = load_registry().resolve("cucumber-seg")["network"]


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Put the processor in the card's place; gives what is copied back from it."""
    processor = ("CPUExecutionProvider",)
    monkeypatch.setattr(
        onnx_runtime,
        "_PROVIDERS",
        {**onnx_runtime._PROVIDERS, "cuda": processor, "tensorrt": processor},
    )
    monkeypatch.setattr(onnx_runtime, "_CARD_MEMORY", "cpu")
    copied: list[str] = []
    bound = Card._bound

    def watched(
        self: Card, session: Any, placed: Any, outputs: Any, kept: Any = (), **s: Any
    ) -> Any:
        copied.extend(name for name in outputs if name not in kept)
        return bound(self, session, placed, outputs, kept, **s)

    monkeypatch.setattr(Card, "_bound", watched)
    return copied


def picture() -> Any:
    return next(iter(open_source(example_captures()))).load().color


def alike(one: Instance, other: Instance) -> None:
    assert one.box == pytest.approx(other.box, abs=1e-3)
    assert one.confidence == pytest.approx(other.confidence, abs=1e-5)
    for mine, theirs in ((one.detector_mask, other.detector_mask), (one.mask, other.mask)):
        assert (mine is None) == (theirs is None)
        if mine is not None and theirs is not None:
            assert np.count_nonzero(mine != theirs) <= 2


def test_every_network_beside_the_detector_runs_on_the_card(card: list[str]) -> None:
    """Its masks are summed there: no prototypes come back, and nothing else changes."""
    color, fruit_by_runtime = picture(), {}
    for name in ("onnxruntime", "cuda"):
        loader = NetworkLoader(runtime=name)
        detectors = loader.detectors()
        fruit = detectors.find(color)
        fruit_by_runtime[name] = loader.segmenter("mobile-sam").segment(color, fruit)
        ran = {model["name"]: model["runtime"] for model in loader.models}
        assert len(ran) == 3
        place = "cpu" if name == "onnxruntime" else "cuda"
        assert all(place in where for where in ran.values()), ran
    assert len(fruit_by_runtime["cuda"]) == len(fruit_by_runtime["onnxruntime"]) > 1
    for one, other in zip(fruit_by_runtime["cuda"], fruit_by_runtime["onnxruntime"], strict=True):
        alike(one, other)
    assert "sums" in card
    prototypes = open_network(DETECTOR, "onnxruntime", verified=True).outputs[1].name
    assert {prototypes, "planes", "embedding"}.isdisjoint(card)


def test_levels_become_the_same_numbers_there_as_here(card: list[str]) -> None:
    """Padding, means and spreads of each channel: as SAM's encoder takes them."""
    levels = np.random.default_rng(0).integers(0, 256, (2, 5, 7, 3), np.uint8)
    network = open_network(DETECTOR, "cuda", verified=True)
    assert network.card is not None
    for given in (
        Levels(levels),
        Levels(levels[:1], (123.675, 116.28, 0.0), (58.395, 57.12, 57.375), (6, 9)),
        Levels(levels[:1, :4]),
    ):
        there = CardArray(network.card._placed("images", given)).numpy()
        assert np.array_equal(there, given.planes())
    assert Levels(levels[:1], size_px=(6, 9)).planes()[:, :, 5:].max() == 0


def test_memory_is_used_again_and_what_stayed_is_not_overwritten(card: list[str]) -> None:
    network = open_network(DETECTOR, "cuda", verified=True)
    rows, prototypes = (output.name for output in network.outputs)
    name = network.inputs[0].name
    dark, light = (Levels(np.full((1, 64, 64, 3), level, np.uint8)) for level in (20, 220))
    first = network.run({name: dark}, [prototypes])
    kept = first[prototypes].numpy().copy()
    second = network.run({name: light}, [prototypes])
    assert not np.array_equal(first[rows], second[rows])
    assert np.array_equal(first[prototypes].numpy(), kept)
    weights = np.eye(kept.shape[1], dtype=np.float32)[:2]
    sums = network.mixed(prototypes, first[prototypes], weights)
    assert np.allclose(sums, kept[0, :2], atol=1e-6)
    assert network.mixed(prototypes, first[prototypes], weights[:0]).shape == (0, *kept.shape[2:])
    # Whoever asks without naming it gets an array.
    assert isinstance(network.run({name: dark})[prototypes], np.ndarray)


def test_a_failure_on_the_card_names_the_size(card: list[str]) -> None:
    network = open_network(DETECTOR, "cuda", verified=True)
    name = network.inputs[0].name
    with pytest.raises(ModelError, match=r"fails on images \(1, 33, 64, 3\)"):
        network.run({name: Levels(np.zeros((1, 33, 64, 3), np.uint8))})


def test_precision_is_asked_of_each_provider() -> None:
    def asked(provider: str, full_precision: bool) -> dict[str, str]:
        return provider_options(
            f"{provider}ExecutionProvider", full_precision=full_precision, engines=Path("e")
        )

    assert asked("CUDA", True)["use_tf32"] == "0"
    assert asked("CUDA", False) == {"use_tf32": "1"}
    half, full = asked("Tensorrt", False), asked("Tensorrt", True)
    assert (half["trt_fp16_enable"], full["trt_fp16_enable"]) == ("1", "0")
    assert half["trt_engine_cache_enable"] == half["trt_timing_cache_enable"] == "1"
    assert half["trt_engine_cache_path"] == "e"


def test_tensorrt_gets_the_networks_folder_and_small_networks_run_on_cuda(
    card: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    loader = NetworkLoader(runtime="tensorrt", full_precision=False)
    loader.detectors()
    ran = {model["name"]: model["runtime"] for model in loader.models}
    assert ran["cucumber-seg"] == "onnxruntime (tensorrt, f16)"
    assert ran["cucumber-fruit"] == "onnxruntime (cuda, f32)"
    folders = sorted((tmp_path / "cucumbervision/engines").iterdir())
    assert [folder.name.rsplit("-", 1)[1] for folder in folders] == ["f16"]


def test_engines_lie_in_a_folder_of_the_networks_content_that_nobody_else_may_write(
    tmp_path: Path,
) -> None:
    cache, odd = tmp_path / "engines", tmp_path / "my net; größe$(x).onnx"
    odd.write_bytes(b"a")
    folder = engine_folder(odd, full_precision=True, cache=cache)
    assert folder.name.startswith("my_net_gr_e_x_-")
    assert folder.stat().st_mode & 0o777 == cache.stat().st_mode & 0o777 == 0o700
    assert engine_folder(odd, full_precision=True, cache=cache) == folder
    assert engine_folder(odd, full_precision=False, cache=cache) != folder
    odd.write_bytes(b"b")
    assert engine_folder(odd, full_precision=True, cache=cache) != folder
    folder.chmod(0o777)
    odd.write_bytes(b"a")
    with pytest.raises(ModelError, match="others could put engines there"):
        engine_folder(odd, full_precision=True, cache=cache)
    folder.chmod(0o700)
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ModelError, match="others could put engines there"):
        engine_folder(odd, full_precision=True, cache=cache)
