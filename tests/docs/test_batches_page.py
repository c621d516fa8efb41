from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "batches.md"


def test_examples(run_page: Callable[[Path], doctest.TestResults]) -> None:
    result = run_page(PAGE)
    assert result.attempted >= 7
    assert result.failed == 0
