from __future__ import annotations

from datetime import date, timedelta

import pytest
from tests.greenhouse.rounds.conftest import MORNING, SaveWalk
from tests.simulated_rows import SimulatedRow, simulate_row

from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import CucumberVisionError, RoundError
from cucumbervision_greenhouse.rounds import harvest
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.store.repository import Store

DAY = harvest.walked_on(MORNING)
LATER = DAY + timedelta(30)


@pytest.fixture
def seen(store: Store, save_walk: SaveWalk) -> int:
    save_walk(simulate_row(SimulatedRow(fruit=30, per_m=10), 1))
    return len(fruit_table(read_round(store, MORNING.key)))


def test_a_table_of_a_spreadsheet_is_read_and_unknown_columns_are_named() -> None:
    text = "Day;Row;Class;Crates;kg;By;Weather\n28-11-2026;3;I;2,5;8,4;Ana;dry\n2026-11-29;;;1\n"
    (first, second), unknown = harvest.read_harvest(text, 12)
    assert (first.day, first.row, first.class_) == (date(2026, 11, 28), "3", "I")
    assert (first.fruit, first.kg) == (30.0, 8.4)
    assert (second.day, second.row, second.fruit, second.kg) == (date(2026, 11, 29), "", 12.0, None)
    assert sorted(unknown) == ["by", "weather"]
    [tabs], _ = harvest.read_harvest("day\tfruit\n2026-11-28\t7", 12)
    assert tabs.fruit == 7


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("day,fruit\n2026-11-28,7,5", "line 2 needs fruit or crates, and no more cells"),
        ("day;kg\n2026-11-28;7", "line 2 needs fruit or crates"),
        ("day;fruit\nyesterday;7", "line 2: 'day'"),
        ("day;fruit\n2026-11-28;-7", "line 2: 'fruit'"),
        ("day;fruit\n2026-11-28;many", "line 2: 'fruit'"),
        ("fruit\n7", "line 2: 'day'"),
    ],
)
def test_what_is_no_harvest_is_refused_with_its_line(text: str, fault: str) -> None:
    with pytest.raises(RoundError, match=fault):
        harvest.read_harvest(text, 12)


def test_a_harvest_of_another_year_or_of_more_fruit_than_were_seen_changes_nothing(
    store: Store, seen: int
) -> None:
    for day, fruit, fault in (
        (DAY - timedelta(365), 3, "is not between the first round of this house and today"),
        (LATER + timedelta(1), 3, "is not between the first round of this house and today"),
        (DAY, seen + 1, f"{seen + 1} fruit were picked on {DAY}, and the round before saw {seen}"),
    ):
        lines, _ = harvest.read_harvest(f"day;fruit\n{day};{fruit}", 12)
        with pytest.raises(CucumberVisionError, match=fault):
            harvest.keep_harvest(store, MORNING.key, lines, LATER)
    lines, _ = harvest.read_harvest(f"day;row;fruit\n{DAY};9;1", 12)  # a row that nobody walked
    with pytest.raises(RoundError, match="saw 0"):
        harvest.keep_harvest(store, MORNING.key, lines, LATER)
    assert store.log() == []


def test_a_harvest_is_kept_replaced_and_taken_back(store: Store, seen: int) -> None:
    walks = store.rounds()
    ticked = store.detections(MORNING.key)[0].key
    store.pick([ticked], at_s=MORNING.started_s + 86400.0)
    assert harvest.harvests(store, walks) == {DAY + timedelta(1): (1.0, None)}
    lines, _ = harvest.read_harvest(f"day;class;fruit;kg\n{DAY};I;3;1.2\n{DAY};II;2;0.8", 12)
    harvest.keep_harvest(store.signed("ana"), MORNING.key, lines, LATER)
    lines, _ = harvest.read_harvest(f"day;class;fruit\n{DAY};II;4", 12)
    newest = harvest.keep_harvest(store, MORNING.key, lines, LATER)
    assert harvest.harvests(store, walks)[DAY] == (7.0, 1.2)
    assert [(mark.kind, mark.by) for mark in store.log(kind="harvest")][1] == ("harvest", "ana")
    store.undo(number=newest)
    assert harvest.harvests(store, walks)[DAY] == (5.0, 2.0)
    profile = load_profile("long-cucumber")
    assert harvest.fruit_kg(harvest.harvests(store, walks), [], profile) == 0.4
    assert harvest.fruit_kg({}, [], profile) is None


def test_a_forecast_is_compared_with_what_was_picked_since(store: Store, seen: int) -> None:
    profile, walks = load_profile("long-cucumber"), store.rounds()
    assert harvest.compare_harvests(store, walks, profile, {}, LATER) == []
    views = store.detections(MORNING.key)
    before = harvest.compare_harvests(store, walks, profile, {DAY: (5.0, None)}, LATER)
    assert [(x.days, x.rounds, x.harvest) for x in before] == [(1, 1, 5), (3, 1, 5), (7, 1, 5)]
    assert 0 <= before[0].forecast <= before[1].forecast <= before[2].forecast <= seen
    for line in before:
        assert line.error == pytest.approx(abs(line.forecast - 5) / 5)
    # What was ticked since does not change what had been forecast.
    store.pick([view.key for view in views], at_s=MORNING.started_s + 10)
    assert harvest.compare_harvests(store, walks, profile, {DAY: (5.0, None)}, LATER) == before
    # A window that is not over yet is not compared.
    soon = harvest.compare_harvests(store, walks, profile, {DAY: (5.0, None)}, DAY + timedelta(2))
    assert [x.days for x in soon] == [1]
