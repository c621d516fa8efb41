"""A few faults that need no server, as the command tries them."""

from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision_lab.robustness.faults import Outcome, _without, try_faults


def test_damage_and_a_folder_that_goes_lose_no_other_row() -> None:
    found = try_faults(["flipped", "folder"])
    assert [one.lost for one in found] == [False, False]
    assert found[0].seen.startswith("in/c1/depth_000000.png: is truncated or damaged; copy")
    assert "c2" in found[1].seen
    assert "the file is missing" in found[1].seen


def test_an_unknown_fault_is_named() -> None:
    with pytest.raises(CucumberVisionError, match=r"no fault is called 'fire'; take truncated"):
        try_faults(["fire"])


def test_the_trials_folder_is_not_shown(tmp_path: Path) -> None:
    one = Outcome("x", f"cucumbervision: {tmp_path}/a.png: broken", "kept")
    assert _without(one, str(tmp_path)).seen == "a.png: broken"
