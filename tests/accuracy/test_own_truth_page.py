"""The page on one's own truth: its examples are run."""

from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path

from cucumbervision.pipeline.calibrated import CalibrationFlag

PAGE = Path(__file__).parents[2] / "docs" / "own-truth.md"


def test_examples(run_page: Callable[[Path], doctest.TestResults]) -> None:
    result = run_page(PAGE)
    assert result.attempted > 15
    assert result.failed == 0


def test_every_flag_is_explained() -> None:
    page = PAGE.read_text(encoding="utf-8")
    flags = [value for name, value in vars(CalibrationFlag).items() if name.isupper()]
    assert len(flags) == 3
    assert all(f"`{flag}`" in page for flag in flags)
