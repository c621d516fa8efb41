from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path

from cucumbervision.crop.profiles import CropProfile

PAGE = Path(__file__).parents[2] / "docs" / "agronomy.md"


def test_examples_of_the_page_hold(run_page: Callable[[Path], doctest.TestResults]) -> None:
    result = run_page(PAGE)
    assert result.attempted > 20
    assert result.failed == 0


def test_page_names_every_key_of_a_profile() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [key for key in CropProfile.model_fields if f"`{key}`" not in text] == []
