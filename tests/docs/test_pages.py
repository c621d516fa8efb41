from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize(("page", "least"), [("batches", 7), ("exports", 11), ("safety", 7)])
def test_the_examples_of_a_page_hold(
    run_page: Callable[[Path], doctest.TestResults], page: str, least: int
) -> None:
    result = run_page(DOCS / f"{page}.md")
    assert result.attempted >= least
    assert result.failed == 0
