"""The page on measurements names every column and every code that a row may hold."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cucumbervision.methods.flags import FLAGS, Flag
from cucumbervision.methods.result import Choice, LengthKind, MethodName, Reason
from cucumbervision.run.fields import FIELDS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "measurements.md").read_text(encoding="utf-8")


def test_columns_stand_in_their_order() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (\w*) \| (.+?) \|$", PAGE, re.M)
    assert rows[-len(FIELDS) :] == [(c.name, c.unit, c.says) for c in FIELDS]


def test_flags_are_those_of_the_table() -> None:
    assert {*FLAGS} == {*Flag}
    part = PAGE.split("## Flags")[1].split("## Columns")[0]
    rows = re.findall(r"^\| `([\w-]+)` \| (.+?) \|$", part, re.M)
    assert rows == [(str(flag), line.meaning) for flag, line in FLAGS.items()]


@pytest.mark.parametrize(
    "code", [*Choice, *(r for r in Reason if r is not Reason.OK), *LengthKind, *MethodName, *Flag]
)
def test_codes_are_explained(code: str) -> None:
    assert f"`{code}`" in PAGE or (code in set(MethodName) and str(code) in PAGE)
