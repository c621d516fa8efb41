from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "safety.md"


def test_examples_of_the_page_hold(run_page: Callable[[Path], doctest.TestResults]) -> None:
    result = run_page(PAGE)
    assert result.attempted > 6
    assert result.failed == 0
