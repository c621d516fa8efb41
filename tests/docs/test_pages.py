"""Pages of `docs/`: their examples are run, and they name every key of what they describe."""

from __future__ import annotations

import doctest
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
import typer

from cucumbervision.capture.readers.native import Manifest
from cucumbervision.cli.app import app
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.methods.flags import FLAGS, Flag
from cucumbervision.methods.result import Choice, LengthKind, MethodName, Reason
from cucumbervision.run.fields import FIELDS
from cucumbervision.stream.fruit_stream import FRAME_FIELDS, TRACK_FIELDS
from cucumbervision_greenhouse.rounds.walking import PoseLine
from cucumbervision_greenhouse.store.repository import Store

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = {
    **{"agronomy": 21, "batches": 7, "camera": 3, "captures": 21, "exports": 11},
    **{"integration": 3, "measurements": 9, "own-truth": 16, "rounds": 4, "safety": 7},
    "store": 18,
}
NAMES: dict[str, Iterable[str]] = {
    "agronomy": CropProfile.model_fields,
    "captures": Manifest.model_fields,
    "integration": [field.name for field in (*FRAME_FIELDS, *TRACK_FIELDS)],
    "own-truth": (Flag.NOT_COVERED, Flag.OTHER_MASK, Flag.OTHER_VERSION, Flag.OUTSIDE_RANGE),
}


@pytest.mark.parametrize(("page", "least"), EXAMPLES.items())
def test_the_examples_of_a_page_hold(
    run_page: Callable[[Path], doctest.TestResults], page: str, least: int
) -> None:
    result = run_page(DOCS / f"{page}.md")
    assert result.attempted >= least
    assert result.failed == 0


@pytest.mark.parametrize(("page", "names"), NAMES.items())
def test_a_page_names_every_key(page: str, names: Iterable[str]) -> None:
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    assert [name for name in names if f"`{name}`" not in text] == []


def test_what_the_page_on_the_store_calls_exists() -> None:
    text = (DOCS / "store.md").read_text(encoding="utf-8")
    called = set(re.findall(r"store(?:\.signed\(\"\w+\"\))?\.(\w+)\(", text))
    assert called >= {"save_stop", "undo"}
    assert [name for name in called if not hasattr(Store, name)] == []


ROOT = Path(__file__).parents[2]
MEASUREMENTS = (ROOT / "docs" / "measurements.md").read_text(encoding="utf-8")


def test_columns_stand_in_their_order() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (\w*) \| (.+?) \|$", MEASUREMENTS, re.M)
    assert rows[-len(FIELDS) :] == [(c.name, c.unit, c.says) for c in FIELDS]


def test_flags_are_those_of_the_table() -> None:
    assert {*FLAGS} == {*Flag}
    part = MEASUREMENTS.split("## Flags")[1].split("## Columns")[0]
    rows = re.findall(r"^\| `([\w-]+)` \| (.+?) \|$", part, re.M)
    assert rows == [(str(flag), line.meaning) for flag, line in FLAGS.items()]


@pytest.mark.parametrize(
    "code", [*Choice, *(r for r in Reason if r is not Reason.OK), *LengthKind, *MethodName, *Flag]
)
def test_codes_are_explained(code: str) -> None:
    assert f"`{code}`" in MEASUREMENTS or (code in set(MethodName) and str(code) in MEASUREMENTS)


ROUNDS = Path(__file__).parents[2] / "docs" / "rounds.md"


def test_every_pose_column_is_named() -> None:
    heads = re.findall(r"^\| (`[^|]+) \|", ROUNDS.read_text(encoding="utf-8"), re.MULTILINE)
    named = {name for head in heads for name in re.findall(r"`(\w+)`", head)}
    assert named == set(PoseLine.model_fields)


def test_commands_and_options_exist() -> None:
    command = typer.main.get_command(app)
    known = getattr(getattr(command, "commands", {})["round"], "commands", {})
    lines = re.findall(
        r"^cucumbervision round (.+)$", ROUNDS.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert len(lines) > 6
    for line in lines:
        name, *rest = line.split("#")[0].split()
        options = {option for param in known[name].params for option in param.opts}
        assert {word for word in rest if word.startswith("--")} <= options
