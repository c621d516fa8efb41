"""What runs of the fuzzer did, as JSON, and the sum of many runs."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision_lab.robustness.fuzz import FuzzResult


def as_json(result: FuzzResult, indent: int | None = 1) -> str:
    """Return a result as JSON, for figures in documents."""
    return json.dumps(
        {
            "seed": result.seed,
            "inputs": sum(result.tried.values()),
            "refused": sum(result.refused.values()),
            "seconds": round(result.seconds, 1),
            "doors": dict(result.tried),
            "finds": dict(result.found),
        },
        indent=indent,
    )


@dataclass(frozen=True)
class LogSum:
    """What all runs of a log did together.

    Parameters
    ----------
    runs, inputs, refused, finds : int
        Counts; of runs with one seed and readers the longest counts alone.
    seconds : float
        Time taken.
    readers : Counter of str
        Inputs by reader.
    """

    runs: int
    inputs: int
    refused: int
    finds: int
    seconds: float
    readers: Counter[str]

    @property
    def fewest(self) -> str:
        """The three readers with the fewest inputs.

        Examples
        --------
        >>> LogSum(1, 9, 0, 0, 1.0, Counter({"a": 4, "b": 1, "c": 2, "d": 2})).fewest
        'b 1, c 2, d 2'
        """
        least = sorted(self.readers.items(), key=lambda one: one[1])[:3]
        return ", ".join(f"{name} {count:,}" for name, count in least)


def add_to_log(result: FuzzResult, log: Path) -> LogSum:
    """Add a run to a log of runs, one JSON line each; return the sum of all."""
    with log.open("a", encoding="utf-8") as file:
        file.write(as_json(result, None) + "\n")
    runs: dict[tuple[int, frozenset[str]], dict[str, Any]] = {}
    for line in log.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        key = one["seed"], frozenset(one["doors"])
        if key not in runs or one["inputs"] > runs[key]["inputs"]:
            runs[key] = one
    readers: Counter[str] = Counter()
    for one in runs.values():
        readers.update(one["doors"])
    return LogSum(
        len(runs),
        sum(one["inputs"] for one in runs.values()),
        sum(one["refused"] for one in runs.values()),
        sum(sum(one["finds"].values()) for one in runs.values()),
        sum(one["seconds"] for one in runs.values()),
        readers,
    )
