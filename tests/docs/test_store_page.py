"""The page on the store: its examples are run."""

from __future__ import annotations

import doctest
import re
from pathlib import Path

from cucumbervision_greenhouse.store.repository import Store

PAGE = Path(__file__).parents[2] / "docs" / "store.md"


def test_the_examples_give_what_the_page_says() -> None:
    done = doctest.testfile(str(PAGE), module_relative=False, encoding="utf-8")
    assert done.attempted >= 18
    assert done.failed == 0


def test_what_the_page_calls_exists() -> None:
    text = PAGE.read_text(encoding="utf-8")
    called = set(re.findall(r"store(?:\.signed\(\"\w+\"\))?\.(\w+)\(", text))
    assert called >= {"save_stop", "undo"}
    assert [name for name in called if not hasattr(Store, name)] == []
