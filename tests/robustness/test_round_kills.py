"""Kills of a round: they come to an end, within writes, and a round that cannot end is lost."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from tests.robustness import round_kills, trial


def test_a_killed_round_is_whole_and_the_kills_come_to_an_end(tmp_path: Path) -> None:
    counted: list[int] = []
    one = round_kills.kill_rounds(tmp_path, 2, tick=counted.append)
    assert (one.lost, one.kept) == (False, "1 rounds of 8 stops, each stop whole and once")
    assert re.match(r"`round add` killed 2 times \(kill -9\), [012] of them within a", one.fault)
    assert sum(counted) == 2


def test_a_round_that_refuses_stops_is_said_and_not_begun_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at_one_place(folder: Path, count: int) -> Path:
        source = trial.captures(folder, count)
        place = (source / "c0" / "capture.json").read_bytes()
        for k in range(1, count):
            (source / f"c{k}" / "capture.json").write_bytes(place)
        return source

    monkeypatch.setattr(round_kills, "captures", at_one_place)
    one = round_kills.kill_rounds(tmp_path, 50)
    assert one.lost
    assert re.match(r"it ended by itself with 1 of 8 stops: .*choose another position", one.kept)
