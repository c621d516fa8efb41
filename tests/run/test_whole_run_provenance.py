"""What has to be measured again when an option, a file or a network changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.capture.intrinsics import DepthAlong, Stream
from cucumbervision.capture.source import ReadOptions
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import CucumberVisionError
from cucumbervision.methods.result import LengthDefinition, MethodName, Selector
from cucumbervision.networks.registry import load_registry
from cucumbervision.plugins import Plugin
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import deciding_sha256

USUAL, REGISTRY = MeasureOptions(), load_registry()


@pytest.mark.parametrize(
    "change",
    [
        {"methods": (MethodName.M1,)},
        {"selector": Selector.PAPER},
        {"length": LengthDefinition.THREAD},
        {"reading": ReadOptions(depth_unit_m=0.0001)},
        {"reading": ReadOptions(depth_along=DepthAlong.RAY)},
        {"reading": ReadOptions(aligned_to=Stream.DEPTH)},
        {"camera_up": "left"},
        {"classes": ("ripe",)},
        {"segmenter": "none"},
        {"end_look": False},
        {"accepted_m": load_profile("mini-cucumber").accepted_m},
    ],
)
def test_options_decide(change: dict[str, Any]) -> None:
    assert deciding_sha256(replace(USUAL, **change), REGISTRY) != deciding_sha256(USUAL, REGISTRY)


def test_the_content_of_named_files_decides(tmp_path: Path) -> None:
    boxes = tmp_path / "boxes.json"
    options = replace(USUAL, instances=str(boxes))
    with pytest.raises(CucumberVisionError, match="no such file"):
        deciding_sha256(options, REGISTRY)
    boxes.write_text("{}")
    before = deciding_sha256(options, REGISTRY)
    boxes.write_text("{ }")
    assert deciding_sha256(options, REGISTRY) != before


def test_a_network_in_use_decides() -> None:
    (seg, *_) = (model for model in REGISTRY.models if model.task == "segment")
    other = replace(seg, files=(replace(seg.files[0], sha256="0" * 64),))
    changed = tuple(other if model is seg else model for model in REGISTRY.shipped)
    registry = replace(REGISTRY, shipped=changed)
    assert deciding_sha256(USUAL, registry) != deciding_sha256(USUAL, REGISTRY)


def test_a_plug_in_without_a_version_is_never_the_same() -> None:
    known = Plugin("methods", "M7", "other:M7", "other", "1.0")
    unknown = replace(known, version="")
    one, again = (deciding_sha256(USUAL, REGISTRY, [known]) for _ in range(2))
    assert one == again != deciding_sha256(USUAL, REGISTRY)
    assert deciding_sha256(USUAL, REGISTRY, [unknown]) != deciding_sha256(
        USUAL, REGISTRY, [unknown]
    )
