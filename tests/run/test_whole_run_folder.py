"""What has to be measured again when an option, a file or a network changes."""

from __future__ import annotations

import subprocess
import sys
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.capture.intrinsics import DepthAlong, Stream
from cucumbervision.capture.source import ReadOptions
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import CucumberVisionError
from cucumbervision.files import as_path
from cucumbervision.methods.result import LengthDefinition, MethodName, Selector
from cucumbervision.networks.registry import load_registry
from cucumbervision.plugins import Plugin
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import OutputFolder, deciding_sha256


@pytest.fixture(params=["local", "remote"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> OutputFolder:
    """An output folder on the disk, or on a store."""
    if request.param == "local":
        return OutputFolder(tmp_path / "out")
    pytest.importorskip("upath")
    return OutputFolder(as_path(f"memory://{uuid.uuid4().hex}"))


@pytest.fixture
def local(tmp_path: Path) -> OutputFolder:
    return OutputFolder(tmp_path / "out")


def test_a_file_replaces_another_and_leaves_no_other(out: OutputFolder) -> None:
    assert not out.has("overlays/a.png")
    for data in (b"first", b"second"):
        out.write("overlays/a.png", data)
    assert (out.path / "overlays/a.png").read_bytes() == b"second"
    assert [path.name for path in (out.path / "overlays").iterdir()] == ["a.png"]
    with out.replacing("table.csv") as path:
        assert path.suffix == ".csv"
        path.write_text("a,b\n")
    assert (out.path / "table.csv").read_text() == "a,b\n"


def test_what_fails_half_way_leaves_what_was_there(out: OutputFolder) -> None:
    out.write("table.csv", b"whole")

    def break_off() -> None:
        with out.replacing("table.csv") as path:
            path.write_bytes(b"ha")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        break_off()
    assert (out.path / "table.csv").read_bytes() == b"whole"
    assert [path.name for path in out.path.rglob("*") if path.is_file()] == ["table.csv"]


def test_the_next_run_removes_what_a_killed_one_left_half_written(local: OutputFolder) -> None:
    pytest.importorskip("fcntl")
    program = (
        "import os, signal, sys; from pathlib import Path\n"
        "from cucumbervision.run.whole_run import OutputFolder\n"
        "with OutputFolder(Path(sys.argv[1])).replacing('overlays/a.png') as path:\n"
        "    path.write_bytes(b'ha'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, local.path], check=False)
    left = [path for path in local.path.rglob("*") if path.is_file()]
    assert [path.read_bytes() for path in left] == [b"ha"]
    with local.locked(".lock"):
        local.write("table.csv", b"whole")
    assert sorted(path.name for path in local.path.iterdir()) == [".lock", "overlays", "table.csv"]
    assert not list((local.path / "overlays").iterdir())


def test_two_runs_do_not_write_into_one_folder(local: OutputFolder) -> None:
    pytest.importorskip("fcntl")
    with local.locked(".lock"):
        folder = OutputFolder(local.path)
        with (
            pytest.raises(CucumberVisionError, match="another run is writing into it; wait"),
            folder.locked(".lock"),
        ):
            raise AssertionError
    with local.locked(".lock"):
        pass


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
