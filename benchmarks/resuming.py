"""Measure numbered fruit one after the other, and resume an interrupted run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
from rich.progress import track

Rows = list[dict[str, Any]]


def rows_of(count: int, measured: Callable[[int], Rows], keep: Path | None) -> pd.DataFrame:
    """Return the rows of the first `count` fruit; those that `keep` holds are not measured."""
    lines = keep.read_text().splitlines() if keep and keep.exists() else []
    done: dict[int, Rows] = dict(json.loads(line) for line in lines)
    for number in track(range(count), "fruit"):
        if number not in done:
            done[number] = measured(number)
            if keep:
                with keep.open("a") as file:
                    file.write(json.dumps([number, done[number]]) + "\n")
    return pd.DataFrame([row for number in range(count) for row in done[number]])
