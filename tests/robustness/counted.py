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
_OTHERS = {
    "bit flips": ("single bits of a store's file", "missed"),
    "faults": ("faults in real commands", "lost"),
}
"""Title of each other kind of trial, and its worst outcome."""
_LONG = {
    "hour": "captures of a stream that is looked at every minute",
    "week": "captures of a week with kills, compared with one without",
}


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
    for generator, title in _GENERATORS.items():
        for name in sorted(name for name in counts if name.partition(":")[0] == generator):
            rows.append(_damaged_row(title + name.removeprefix(generator), counts[name]))
    for name, (title, bad) in _OTHERS.items():
        if found := counts.get(name):
            words = [f"{n:,} {word}" for word, n in sorted(found.items(), key=lambda one: -one[1])]
            words += [] if bad in found else [f"none {bad}"]
            rows.append(f"| {title} | {sum(found.values()):,} | {', '.join(words)} |")
    for name, title in _LONG.items():
        if run := counts.get(name):
            rows.append(f"| {title} | {run['inputs']:,} | {run['came']} |")
    return "\n".join(rows) + "\n"


def _damaged_row(title: str, one: Mapping[str, Any]) -> str:
    tried, refused = (sum(one[which].values()) for which in ("tried", "refused"))
    networks = one["tried"].get("ONNX", 0)
    among = f" ({networks:,} of them ONNX)" if networks else ""
    found, mended = len(one["findings"]), sum(one["mended"].values())
    came = f"{refused:,} refused by name, the others read; {found} findings"
    return f"| {title} | {tried:,}{among} | {came}{f', {mended} mended' if mended else ''} |"


def with_counts(page: str, counts: Mapping[str, Any]) -> str:
    """Return a page of the documentation with these counts."""
    return _MARKED.sub(lambda found: f"{found[1]}{counts_table(counts)}{found[2]}", page)


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]):
        page = with_counts(path.read_text(encoding="utf-8"), read_counts(COUNTS))
        path.write_text(page, encoding="utf-8")
