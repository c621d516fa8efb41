from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.greenhouse.conftest import whole_stop
from tests.greenhouse.rounds.conftest import SaveWalk
from tests.simulated_rows import SimulatedRow, Walk, grow_plants, simulate_row, walk

from cucumbervision.capture.frames import Stop
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import RoundError
from cucumbervision.methods.result import Length, LengthDefinition
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.forecast.picking import pick_list, ready_on
from cucumbervision_greenhouse.rounds import day_comparison, forecasting, merge_and_link
from cucumbervision_greenhouse.rounds.forecasting import earlier_lengths
from cucumbervision_greenhouse.rounds.fruit_table import (
    RoundContent,
    find_round,
    fruit_table,
    read_round,
)
from cucumbervision_greenhouse.rounds.merge_and_link import link_rounds, merge_round, row_counts
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    FruitRow,
    LinkKind,
    LinkRecord,
    Round,
    StopRecord,
    key_of,
)
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures

Save = Callable[..., None]
LONG = load_profile("long-cucumber")
KIND = LengthDefinition.CENTRELINE
ROW = SimulatedRow(fruit=60, per_m=10)
MORNING = key_of("rounds", "morning")
NEXT = Round(key_of("rounds", "next"), "next", "house 1", 2 * 86400.0, "long-cucumber")


def forecast_of(store: Store, key: str, *, days: int) -> Forecast:
    """Give the forecast that a round had on its own day."""
    one = find_round(store, key)
    return forecasting.forecast_today(store, one, LONG, one.started_s, days=days)


@pytest.fixture
def row(store: Store, save_walk: Save) -> Walk:
    """A row in the store, merged."""
    simulated = simulate_row(ROW, 1)
    save_walk(simulated)
    merge_round(store, MORNING)
    return simulated


def test_a_round_is_merged_and_counted(store: Store, row: Walk) -> None:
    merge_round(store, MORNING)
    [report] = row_counts(read_round(store, MORNING))
    table = fruit_table(read_round(store, MORNING))
    assert report["fruit"] == len(table)
    assert report["views"] == len(row.views)
    assert report["stop_sd_m"] is not None
    assert report["stop_sd_m"] < 0.02
    at = [line.along_m for line in table if line.along_m is not None]
    assert at == sorted(at)
    assert store.stops(MORNING)[0].fitted_m is not None


def test_merging_again_changes_nothing(store: Store, row: Walk) -> None:
    del row
    before = [(v.key, v.group) for v in store.detections(MORNING)]
    merge_round(store, MORNING)
    assert [(v.key, v.group) for v in store.detections(MORNING)] == before


def test_a_fruit_has_the_length_of_all_its_whole_views(store: Store, row: Walk) -> None:
    del row
    views = store.detections(MORNING)
    several = 0
    for line in fruit_table(read_round(store, MORNING)):
        alone = next(view for view in views if view.key == line.key)
        own = [v for v in views if v.group == line.group]
        whole = [one for one in own if one.length_m is not None and not one.partial]
        if len(whole) < 2:
            assert line == alone.with_(number=line.number)
            continue
        several += 1
        lengths = [one.length_m for one in whole if one.length_m]
        assert min(lengths) - 1e-9 <= (line.length_m or 0) <= max(lengths) + 1e-9
        assert line.length is not None
        assert line.length.sides is not None
        assert line.length.sides[0] == line.length_m
    assert several > 5


def test_growth_is_linked_and_forecast(store: Store, row: Walk, save_walk: Save) -> None:
    store.save_round(NEXT)
    rng = np.random.default_rng(3)
    shift = np.tile([0.2, 0.05, 0.0], (len(row.plants.name), 1))
    later = walk(grow_plants(row.plants, 1.0, shift, rng), ROW, rng)
    save_walk(later, NEXT)
    merge_round(store, NEXT.key)
    [found] = link_rounds(store, MORNING, NEXT.key)
    assert found["shift_m"] == pytest.approx(0.2, abs=0.04)
    assert found["sure"] > 5
    content = read_round(store, NEXT.key)
    before, table = forecasting.earlier_lengths(store, content), fruit_table(content)
    assert 5 < len(before) <= found["sure"]
    states = forecasting.fruit_states(table, 2.0, LONG, earlier=before)
    grown = [state.length_m - state.earlier[0][1] for state in states if state.earlier]
    assert 0.02 < np.median(grown) < 0.04
    # Each has the length that the list of fruit gives it, by all its views.
    by_one_view = {view.key: view.length_m for view in store.detections(NEXT.key)}
    assert any(by_one_view[line.key] != line.length_m for line in table)
    said = forecast_of(store, NEXT.key, days=2)
    assert said.growth.fruit > 5
    # Each fruit counts on each day, whether its class is decided or not.
    np.testing.assert_allclose(said.house.expected.sum(axis=1), len(table))


def test_a_fruit_without_a_length_counts_as_one_like_the_others(store: Store) -> None:
    fruit = [FruitRow(k, length=Length(0.25, KIND, 0.24, 0.26, KIND)) for k in (1, 2, 3, 4)]
    fruit[1] = FruitRow(2)  # found, and not measured
    captures = (CaptureRecord("a", fruit=tuple(fruit)),)
    store.save_stop(StopRecord("1", key=key_of("only"), round_key=MORNING, captures=captures))
    found = forecast_of(store, MORNING, days=2)
    np.testing.assert_allclose(found.house.expected.sum(axis=1), 4)
    # 25 cm, give or take 1, with a scale that is 1 % unsure: each class I or II.
    ready = ready_on(found)
    assert (ready.sure, ready.may_be) == (0, 4)
    assert 1.5 < ready.fruit < 2.5
    assert found.ready() == pytest.approx([0.5] * 4, abs=0.15)


def test_a_measured_depth_scale_narrows_what_all_lengths_share() -> None:
    def site(error: float) -> list[ArtifactRecord]:
        scale = {"value": 0.98, "standard_error": error}
        return [ArtifactRecord("calibration", "bench", details={"depth_scale": scale})]

    assert forecasting.shared_scale_sd([]) == 0.01
    assert forecasting.shared_scale_sd([site(0.00098), site(0.00196)]) == pytest.approx(0.002)
    own_truth_alone = ArtifactRecord("calibration", "b", details={"depth_scale": None})
    assert forecasting.shared_scale_sd([site(0.00098), [own_truth_alone]]) == 0.01


def test_growth_is_followed_through_three_rounds_and_no_other_is_read(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    days_read: list[str] = []

    def reading(opened: Store, key: str) -> RoundContent:
        days_read.append(key)
        return read_round(opened, key)

    monkeypatch.setattr(day_comparison, "read_round", reading)
    for hour in range(1, 4):
        store.save_round(Round(key_of("early", hour), "early", "", hour * 3600.0))
    keys = []
    for day in (2, 3, 4):
        record = Round(key_of("three", day), f"day {day}", "", day * 86400.0)
        store.save_round(record)
        fruit = FruitRow(1, length=Length(0.1 + 0.03 * day))
        capture = CaptureRecord("c", fruit=(fruit,))
        stop = StopRecord("1", key=key_of("s", day), round_key=record.key, captures=(capture,))
        store.save_stop(stop)
        keys.append((record.key, store.detections(record.key)[0].key))

    def save_link(first: tuple[str, str], last: tuple[str, str]) -> None:
        link = LinkRecord(LinkKind.GROWTH, first[1], last[1], 1.0)
        store.save_growth(first[0], last[0], [link])

    save_link(keys[0], keys[1])
    save_link(keys[1], keys[2])
    content = read_round(store, keys[2][0])
    [(name, points)] = forecasting.earlier_lengths(store, content).items()
    assert (name, [day for day, *_ in points]) == (keys[2][1], [2.0, 3.0])
    assert days_read == [keys[1][0], keys[0][0]]


def test_picked_fruit_leave_list_and_counts(store: Store, row: Walk) -> None:
    del row
    before = forecast_of(store, MORNING, days=0)
    first, *others = pick_list(before)
    store.pick([first.fruit.fruit_id], at_s=0.0)
    after = forecast_of(store, MORNING, days=0)
    assert first.fruit.fruit_id not in {fruit.fruit_id for fruit in after.fruit}
    assert len(pick_list(after)) == len(others)
    assert ready_on(after).sure == ready_on(before, picked={first.fruit.fruit_id}).sure


def test_stops_without_position_stand_alone(store: Store, save_walk: Save) -> None:
    save_walk(simulate_row(replace(ROW, fruit=20), 1))
    stop = whole_stop(store, store.stops(MORNING)[1].key)
    store.save_stop(replace(stop, key=key_of("lost"), position_m=None))
    merge_round(store, MORNING)
    [report] = row_counts(read_round(store, MORNING))
    lost = sum(len(taken.fruit) for taken in stop.captures)
    assert report["unplaced"] == lost
    alone = [v for v in store.detections(MORNING) if v.stop_key == key_of("lost")]
    assert [v.views for v in alone] == [1] * lost


def test_links_are_saved_for_all_pairs_of_a_fruit(store: Store, row: Walk) -> None:
    del row
    sizes = [line.views for line in fruit_table(read_round(store, MORNING))]
    links = store.links(MORNING, LinkKind.SAME)
    assert len(links) == sum(size * (size - 1) // 2 for size in sizes)


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
