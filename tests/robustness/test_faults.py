"""A few faults, as the command tries them; the store of the network goes for seconds only."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from tests.greenhouse.store.throwaway_postgres import missing_reason
from tests.robustness.faults import _without, s3_gone, try_faults
from tests.robustness.trial import Outcome

from cucumbervision.errors import CucumberVisionError


def test_damage_and_a_folder_that_goes_lose_no_other_row() -> None:
    found = try_faults(["flipped", "folder"])
    assert [one.lost for one in found] == [False, False]
    assert found[0].seen.startswith("in/c1/depth_000000.png: is truncated or damaged; copy")
    assert "c2" in found[1].seen
    assert "the file is missing" in found[1].seen


def test_a_clock_that_jumps_by_an_hour_changes_nothing() -> None:
    [jumps] = try_faults(["jumps"])
    assert (jumps.lost, jumps.kept) == (False, "6 rows, as without; 3 stops")


@pytest.mark.skipif(os.name != "posix" or os.getuid() != 0, reason="mounts a small disk")
@pytest.mark.skipif(bool(missing_reason()), reason=missing_reason())
def test_postgresql_on_a_full_disk_loses_nothing_and_says_so() -> None:
    [full] = try_faults(["postgres-full"])
    assert not full.lost
    assert "make room on the disk" in full.seen


def test_a_file_of_100_000_fruit_changes_no_row() -> None:
    [many] = try_faults(["instances"])
    assert (many.lost, many.kept) == (False, "30 rows, as with those three alone")


def test_an_unknown_fault_is_named() -> None:
    with pytest.raises(CucumberVisionError, match=r"no fault is called 'fire'; take truncated"):
        try_faults(["fire"])


def test_the_trials_folder_is_not_shown(tmp_path: Path) -> None:
    one = Outcome("x", f"cucumbervision: {tmp_path}/a.png: broken", "kept")
    assert _without(one, str(tmp_path)).seen == "a.png: broken"


def test_killed_processes_lose_no_row() -> None:
    worker, itself = try_faults(["worker", "measure"])
    assert (worker.lost, worker.kept) == (False, "12 of 12 rows, those of one worker")
    assert worker.seen.startswith("12 of 12 fruit measured in 6 captures;")
    assert (itself.lost, itself.seen) == (False, "no tables yet")
    assert "12 of 12 fruit measured in 6 captures, 2 of them by an earlier run" in itself.kept


def test_a_store_that_goes_is_waited_for(tmp_path: Path) -> None:
    pytest.importorskip("moto.server")
    found = s3_gone(tmp_path, gone_s=5.0)
    assert (found.lost, found.kept) == (False, "12 of 12 rows; the run waited and went on")
