"""Counts of what was tried, in one file that every run adds to."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


def read_counts(path: Path) -> dict[str, Any]:
    """Return what a file of counts says; nothing where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def write_counts(path: Path, name: str, counts: Any) -> None:
    """Put a run's counts in the place of its earlier ones."""
    aside = path.with_suffix(".new")
    said = {**read_counts(path), name: counts}
    aside.write_text(json.dumps(said, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    aside.replace(path)


def add_counts(path: Path, name: str, counts: Mapping[str, int]) -> None:
    """Add a run's counts to those of its earlier ones."""
    write_counts(path, name, Counter(read_counts(path).get(name, {})) + Counter(counts))
