"""`scripts/structure`: bound names that are pronouns, with a limit; commands with their options."""

from __future__ import annotations

import ast
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("grimp")
SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "structure"


@pytest.fixture(scope="module")
def structure() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("the source archive has no scripts")
    loader = SourceFileLoader("structure", str(SCRIPT))
    spec = spec_from_loader("structure", loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module


CODE = """
one = mask = 1
box, (far, *rest) = boxes
known: int = 1
for each in rows: pass
with path as left: pass
depths = [own for own in rows if (most := own)]
def area(self, at, /, *some, low=0, **more): key = lambda other: other
match row:
 case [here, *there] | {**beside}: pass
import own
own.found = known[given]
"""
NAMES = (
    "one mask box far rest known each left depths own most at some low more key other "
    "here there beside"
)


def test_bound_names(structure: ModuleType) -> None:
    assert sorted(structure.bound_names(ast.parse(CODE))) == sorted(NAMES.split())


def test_more_pronouns_than_the_limit_are_a_fault(structure: ModuleType, tmp_path: Path) -> None:
    room = tmp_path / "farm" / "rows"
    room.mkdir(parents=True)
    (tmp_path / "farm" / "__init__.py").write_text("mask = depth = axis = 1\n")
    (room / "plants.py").write_text("found = 1\n")  # one of the four names: 25 %
    table, faults = structure.pronouns({"farm": 25.0}, [tmp_path / "farm"])
    assert faults == []
    cells = list(zip(*(list(column.cells) for column in table.columns), strict=True))
    assert cells == [
        ("farm", "4", "1", "25.00"),
        ("farm.rows", "1", "1", "100.00"),
        ("farm/rows/plants.py", "", "1", ""),
    ]
    _, faults = structure.pronouns({"farm": 24.9}, [tmp_path / "farm"])
    assert faults == ["farm: 25.00 % are pronouns, allowed 24.9 %"]
