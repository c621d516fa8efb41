"""Pages of `docs/`: their examples are run, and they name every key of what they describe."""

from __future__ import annotations

import doctest
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from cucumbervision.capture.readers.native import Manifest
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.methods.flags import Flag
from cucumbervision.stream.fruit_stream import FRAME_FIELDS, TRACK_FIELDS
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
