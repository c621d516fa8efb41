"""Counts of what was tried, in one file that every run adds to, and in the documentation.

python -m tests.robustness.counted docs/safety.md
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

COUNTS = Path(__file__).with_name("counts.json")
_MARKED = re.compile(r"(<!-- counts -->\n).*?(<!-- counted -->)", re.DOTALL)
_GENERATORS = {"mutations": "damaged files, our mutations", "hypothesis": "the same, Hypothesis"}


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


def counts_table(counts: Mapping[str, Any]) -> str:
    """Return the counts as a table in Markdown."""
    rows = ["| tried | inputs | came of them |", "|---|--:|---|"]
    for name, title in _GENERATORS.items():
        one = counts[name]
        tried, refused = (sum(one[which].values()) for which in ("tried", "refused"))
        found, mended = len(one["findings"]), sum(one["mended"].values())
        came = f"{refused:,} refused by name, the others read; {found} findings"
        rows.append(f"| {title} | {tried:,} | {came}{f', {mended} mended' if mended else ''} |")
    if flips := counts.get("bit flips"):
        rows.append(_flips_row(flips))
    return "\n".join(rows) + "\n"


def _flips_row(flips: Mapping[str, int]) -> str:
    words = ", ".join(f"{n:,} {word}" for word, n in sorted(flips.items(), key=lambda one: -one[1]))
    missed = "" if "missed" in flips else ", none missed"
    return f"| single bits of a store's file | {sum(flips.values()):,} | {words}{missed} |"


def with_counts(page: str, counts: Mapping[str, Any]) -> str:
    """Return a page of the documentation with these counts."""
    return _MARKED.sub(lambda found: f"{found[1]}{counts_table(counts)}{found[2]}", page)


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]):
        page = with_counts(path.read_text(encoding="utf-8"), read_counts(COUNTS))
        path.write_text(page, encoding="utf-8")
