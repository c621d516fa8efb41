"""Crop packs: a folder with a profile, and networks of its own."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.crop.profiles import load_profile, profile_path
from cucumbervision.errors import CucumberVisionError, ModelError, ModelHashError, ProfileError
from cucumbervision.methods.result import LengthDefinition, MethodName, Selector
from cucumbervision.networks.registry import file_sha256
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions, read_pack


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ({"methods": "M5, m1"}, {"methods": (MethodName.M1, MethodName.M5)}),
        ({"methods": ("m1", "M5")}, {"methods": (MethodName.M1, MethodName.M5)}),
        ({"methods": "ALL"}, {}),
        ({"length": "chord"}, {"length": LengthDefinition.CHORD}),
        ({"selector": "paper"}, {"selector": Selector.PAPER}),
    ],
)
def test_names_are_taken_for_what_they_name(given: dict[str, Any], meant: dict[str, Any]) -> None:
    assert MeasureOptions(**given) == MeasureOptions(**meant)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (
            {"length": "chrod"},
            "length: 'chrod' is not a valid value; give thread or centreline or chord",
        ),
        ({"selector": "bset"}, "selector: 'bset' is not a valid value; give best or paper"),
        ({"methods": ""}, "methods: '' is not a valid value; give M1 or M2"),
        ({"methods": "m1;m2"}, "methods: 'm1;m2' is not a valid value"),
        ({"methods": ("m9",)}, "methods: 'm9' is not a valid value; give M1 or M2"),
        ({"confidence": 25}, "confidence: 25 is not a valid value; give a number from 0 to 1"),
        ({"confidence": float("nan")}, "nan is not a valid value"),
        ({"prompt": "boxes"}, "'boxes' is not a valid value; give box or"),
        ({"runtime": "gpu"}, "'gpu' is not a valid value; give auto or"),
        ({"camera_up": "up"}, "'up' is not a valid value; give top or left or right or bottom"),
    ],
)
def test_what_is_no_choice_is_refused_at_once(given: dict[str, Any], text: str) -> None:
    with pytest.raises(CucumberVisionError, match=text):
        MeasureOptions(**given)


def test_a_measurer_takes_captures_and_says_how_to_get_one() -> None:
    folder: Any = "captures"
    with pytest.raises(CucumberVisionError, match=r"not str; open files .* with open_source"):
        Measurer(MeasureOptions(instances="dataset")).measure(folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copy(profile_path("courgette"), tmp_path / "profile.toml")
    return tmp_path


def test_a_profile_alone_is_a_pack(folder: Path) -> None:
    pack = read_pack(folder)
    assert pack.profile == load_profile(folder) == load_profile("courgette")
    assert (pack.segment, pack.pose, pack.truth) == (None, None, None)
    options = pack.options(MeasureOptions())
    assert options == MeasureOptions().for_crop(load_profile("courgette"))


def test_its_networks_find_the_fruit_unless_others_were_chosen(folder: Path) -> None:
    for name in ("mine-seg.onnx", "mine-pose.onnx", "truth.csv"):
        (folder / name).write_bytes(b"any")
    pack = read_pack(folder)
    assert pack.truth == folder / "truth.csv"
    options = pack.options(MeasureOptions())
    assert (options.instances, options.pose) == (
        str(folder / "mine-seg.onnx"),
        folder / "mine-pose.onnx",
    )
    assert options.accepted_m == load_profile("courgette").accepted_m
    chosen = pack.options(MeasureOptions(instances="dataset", pose=Path("other.onnx")))
    assert (chosen.instances, chosen.pose) == ("dataset", Path("other.onnx"))


def test_what_does_not_belong_together_is_refused(folder: Path) -> None:
    network, card = folder / "mine-seg.onnx", folder / "mine-seg.json"
    network.write_bytes(b"any")
    card.write_text(json.dumps({"sha256": file_sha256(network)}))
    assert read_pack(folder).segment == network
    network.write_bytes(b"another")
    with pytest.raises(ModelHashError, match=r"mine-seg\.onnx: is not the network that mine-seg"):
        read_pack(folder)
    (folder / "more-seg.onnx").write_bytes(b"any")
    with pytest.raises(ModelError, match="holds 2 networks"):
        read_pack(folder)
    (folder / "profile.toml").unlink()
    with pytest.raises(ProfileError, match=r"profile\.toml: the file is missing"):
        read_pack(folder)


def test_a_folder_in_a_network_s_place_is_named(folder: Path) -> None:
    (folder / "mine-seg.onnx").mkdir()
    with pytest.raises(ModelError, match=r"mine-seg\.onnx: cannot be read"):
        read_pack(folder)
