from __future__ import annotations

import doctest
from pathlib import Path

from cucumbervision.agronomy.profile import CropProfile

PAGE = Path(__file__).parents[2] / "docs" / "agronomy.md"


def test_examples_of_the_page_hold() -> None:
    result = doctest.testfile(
        str(PAGE),
        module_relative=False,
        optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS,
        encoding="utf-8",
    )
    assert result.attempted > 20
    assert result.failed == 0


def test_page_names_every_key_of_a_profile() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [key for key in CropProfile.model_fields if f"`{key}`" not in text] == []
