"""The page on measurements names every column and every code that a row may hold."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cucumbervision.measurement.result import LengthKind, Method, Reason
from cucumbervision.measurement.selector import Choice
from cucumbervision.pipeline.calibrated import CalibrationFlag
from cucumbervision.pipeline.intervals import TOO_WIDE
from cucumbervision.pipeline.rows import COLUMNS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "measurements.md").read_text(encoding="utf-8")


def test_columns_stand_in_their_order() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (\w*) \| (.+?) \|$", PAGE, re.M)
    assert rows[-len(COLUMNS) :] == [(c.name, c.unit, c.says) for c in COLUMNS]


@pytest.mark.parametrize(
    "code", [*Choice, *(r for r in Reason if r is not Reason.OK), *LengthKind, *Method]
)
def test_codes_are_explained(code: str) -> None:
    assert str(code) in PAGE


def test_flags_are_explained() -> None:
    sources = [
        *(ROOT / "src/cucumbervision/measurement").glob("*.py"),
        ROOT / "src/cucumbervision/pipeline/run.py",
    ]
    flags = {
        flag
        for source in sources
        for line in source.read_text(encoding="utf-8").splitlines()
        if "flag" in line or "cut" in line
        for flag in re.findall(r'"([a-z]+(?:-[a-z]+)+|uncertain)"', line)
    }
    own = {v for k, v in vars(CalibrationFlag).items() if k.isupper()} | {TOO_WIDE}
    assert {"cut-by-frame", "end-hidden", "box-clipped"} <= flags
    assert [f for f in sorted(flags | own) if f"`{f}`" not in PAGE] == []
