from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path

import pytest

from cucumbervision.stream.fruit_stream import FRAME_FIELDS, TRACK_FIELDS

PAGE = Path(__file__).parents[2] / "docs" / "integration.md"


def test_the_pages_examples_run(run_page: Callable[[Path], doctest.TestResults]) -> None:
    assert run_page(PAGE).failed == 0


@pytest.mark.parametrize("name", [one.name for one in (*FRAME_FIELDS, *TRACK_FIELDS)])
def test_the_page_names_every_field_of_a_stream(name: str) -> None:
    assert f"`{name}`" in PAGE.read_text(encoding="utf-8")
