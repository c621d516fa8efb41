from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from tests.greenhouse.rounds.conftest import SaveWalk
from tests.simulated_rows import SimulatedRow, simulate_row

from cucumbervision.capture.frames import Stop
from cucumbervision.errors import RoundError
from cucumbervision_greenhouse.rounds import merge_and_link
from cucumbervision_greenhouse.rounds.forecasting import earlier_lengths
from cucumbervision_greenhouse.rounds.fruit_table import read_round
from cucumbervision_greenhouse.store.records import CaptureRecord, LinkKind, StopRecord, key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures

MORNING = key_of("rounds", "morning")


@pytest.fixture
def stops(store: Store, save_walk: SaveWalk) -> list[str]:
    """A small simulated row."""
    save_walk(simulate_row(SimulatedRow(fruit=12), 1))
    return [stop.key for stop in store.stops(MORNING)]


def test_the_fruit_of_a_stop_that_is_deleted_meanwhile_are_not_linked(
    store: Store, stops: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save, links = store.save_merging, []

    def deleted_before(key: str, found: list[object], positions: object) -> None:
        links.extend(found)
        for stop in stops:
            store.delete_stop(stop)
        save(key, found, positions)  # type: ignore[arg-type]

    monkeypatch.setattr(store, "save_merging", deleted_before)
    assert merge_and_link.settle(store, MORNING) == ""
    assert links
    assert store.links(MORNING) == []


def test_a_round_that_is_deleted_meanwhile_is_named(store: Store) -> None:
    one = next(one for one in store.rounds())
    later = replace(one, key=key_of("later"), started_s=one.started_s + 86400.0)
    store.save_round(later)
    store.delete_round(later.key)
    with pytest.raises(RoundError, match=f"there is no round {later.key}"):
        merge_and_link.link_rounds(store, MORNING, later.key)


def test_undoing_returns_the_round_whose_stop_was_moved(store: Store, stops: list[str]) -> None:
    store.place_stop(replace(store.stops(MORNING)[0], position_m=1.0))
    store.pick([store.detections(MORNING)[0].key])
    assert merge_and_link.undo(store, MORNING) == []
    assert merge_and_link.undo(store, MORNING) == [MORNING]


def test_a_stop_is_not_moved_to_where_another_is(store: Store) -> None:
    for step, side, at_m in ((1, "left", 0.0), (2, "left", 0.4), (3, "right", 0.4)):
        store.save_stop(StopRecord("3", side, at_m, step, key_of(step), MORNING))
    second = store.stops(MORNING)[1]
    with pytest.raises(RoundError, match=r"stop 1 is at 0\.00 m of that row and side"):
        merge_and_link.move_stop(store, second, Stop("3", "left", 0.0, 2))
    with pytest.raises(RoundError, match="stop 3 is at"):
        merge_and_link.move_stop(store, second, Stop("3", "right", 0.4, 2))
    merge_and_link.move_stop(store, second, Stop("3", "left", 0.4, 2), "by the door")
    # Another camera of the mast stands there too.
    capture = CaptureRecord("c", camera={"fx": 600.0})
    other = (replace(capture, camera={"fx": 601.0}),)
    store.save_stop(StopRecord("5", "left", 0.0, 4, key_of(4), MORNING, captures=(capture,)))
    store.save_stop(StopRecord("5", "left", 0.4, 5, key_of(5), MORNING, captures=other))
    merge_and_link.move_stop(store, store.stops(MORNING)[4], Stop("5", "left", 0.0, 5))
    merge_and_link.move_stop(
        store, store.stops(MORNING)[1], Stop("4", "left", 0.0, 2), "by the door"
    )
    assert [(stop.row, stop.note) for stop in store.stops(MORNING)][1] == ("4", "by the door")


def linked(store: Store, first: str, second: str) -> set[tuple[str, str]]:
    ends = [{detection.key for detection in store.detections(key)} for key in (first, second)]
    links = store.links(second, LinkKind.GROWTH)
    return {(x.first, x.second) for x in links if x.first in ends[0] and x.second in ends[1]}


def three_days(store: Store, save_walk: SaveWalk) -> list[str]:
    """Save a row on three days, settled; return the rounds."""
    begun = next(one for one in store.rounds())
    days = [
        replace(begun, key=key_of("rounds", day), started_s=begun.started_s + 86400.0 * day)
        for day in range(3)
    ]
    walk = simulate_row(SimulatedRow(fruit=12), 1)
    for day, one in enumerate(days):
        store.save_round(one)
        grown = replace(walk.views, length_m=walk.views.length_m + 0.03 * day)
        save_walk(replace(walk, views=grown), one)
    for one in days:
        assert merge_and_link.settle(store, one.key) == ""
    return [one.key for one in days]


def test_a_round_in_another_house_is_linked_there_alone(store: Store, save_walk: SaveWalk) -> None:
    first, second, third = three_days(store, save_walk)
    before = linked(store, first, second), linked(store, second, third)
    assert set(merge_and_link.move_rounds(store, [second], "another")) == {second, third}
    assert (linked(store, first, second), linked(store, second, third)) == (set(), set())
    for key in (second, third):
        assert merge_and_link.settle(store, key) == ""
    assert linked(store, first, third)
    changed = merge_and_link.undo(store, second)
    assert set(changed) == {second, third}
    for key in changed:
        assert merge_and_link.settle(store, key) == ""
    assert (linked(store, first, second), linked(store, second, third)) == before
    assert not linked(store, first, third)


def test_a_round_that_is_brought_back_is_linked_as_before(
    store: Store, save_walk: SaveWalk, tmp_path: Path
) -> None:
    first, second, third = three_days(store, save_walk)
    before = linked(store, first, second), linked(store, second, third)
    assert all(before)
    assert not linked(store, first, third)
    waiting = WaitingCaptures(tmp_path / "waiting")
    assert merge_and_link.delete_round(store, second, waiting) == [third]
    merge_and_link.settle(store, third)
    assert linked(store, first, third)
    store.restore_round(second)
    merge_and_link.settle(store, second)
    assert (linked(store, first, second), linked(store, second, third)) == before
    assert not linked(store, first, third)


def test_days_are_those_of_the_captures_whenever_a_round_was_begun(
    store: Store, save_walk: SaveWalk
) -> None:
    """The later day is uploaded first, both in one evening, into '7' and 'House 7'."""
    begun = next(one for one in store.rounds())
    morning_s = 1_700_000_000.0
    evening_s = morning_s + 10 * 86400.0
    walk = simulate_row(SimulatedRow(fruit=12), 1)
    days = []
    for day, house in ((1, "7"), (0, " HOUSE  7")):
        one = replace(begun, key=key_of("uploaded", day), house=house, started_s=evening_s - day)
        store.save_round(one)
        grown = replace(walk.views, length_m=walk.views.length_m + 0.03 * day)
        taken = replace(one, started_s=morning_s + 86400.0 * day)
        save_walk(replace(walk, views=grown), taken)
        days.append(one.key)
    later, earlier = days
    assert {one.house for one in store.rounds() if one.key in days} == {"7"}
    assert merge_and_link.earlier_rounds(store, earlier) == []
    assert merge_and_link.settle(store, earlier) == merge_and_link.settle(store, later) == ""
    pairs = linked(store, earlier, later)
    assert len(pairs) == 12
    # Growth is that of one day, 3 cm, not of the second between two presses of 'New round'.
    before = earlier_lengths(store, read_round(store, later))
    last_day = (morning_s + 86400.0) / 86400.0
    assert {round(last_day - point[0], 3) for points in before.values() for point in points} == {
        1.0
    }
