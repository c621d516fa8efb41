"""The page on one's own truth: its examples are run."""

from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path

from cucumbervision.methods.flags import Flag

PAGE = Path(__file__).parents[2] / "docs" / "own-truth.md"


def test_examples(run_page: Callable[[Path], doctest.TestResults]) -> None:
    result = run_page(PAGE)
    assert result.attempted > 15
    assert result.failed == 0


def test_every_flag_is_explained() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for flag in (Flag.NOT_COVERED, Flag.OTHER_MASK, Flag.OUTSIDE_RANGE):
        assert f"`{flag}`" in page
