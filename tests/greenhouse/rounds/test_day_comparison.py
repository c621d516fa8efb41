from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from cucumbervision.methods.result import Length, LengthDefinition, LengthKind
from cucumbervision_greenhouse.rounds.day_comparison import (
    Change,
    DayComparison,
    compare_rounds,
    fruit_days,
    offered_pairs,
    same_fruit,
)
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S, earlier_rounds
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.repository import Store, open_store

NOON_S = 1_700_000_000.0
DAYS = [
    records.Round(records.key_of(name), name, "north", NOON_S + number * DAY_S)
    for number, name in enumerate(("monday", "tuesday", "wednesday"))
]
MONDAY, TUESDAY, WEDNESDAY = (record.key for record in DAYS)


def save_stop(
    store: Store,
    round_key: str,
    position_m: float | None,
    lengths: dict[float, Length],
    row: str = "1",
    flags: str = "",
) -> list[str]:
    """Save a stop with a fruit of each length at each offset along the row; return their keys."""
    day = [record.key for record in DAYS].index(round_key)
    fruit = tuple(
        records.FruitRow(
            number,
            score=0.9,
            length=length,
            flags=flags,
            centre_x_m=offset_m,
            centre_y_m=0.0,
            centre_z_m=0.7,
            offset_m=offset_m,
        )
        for number, (offset_m, length) in enumerate(lengths.items(), 1)
    )
    key = records.key_of(round_key, row, position_m)
    store.save_stop(
        records.StopRecord(
            row,
            "left",
            position_m,
            key=key,
            round_key=round_key,
            taken_s=NOON_S + day * DAY_S + (position_m or 0.0),
            captures=(records.CaptureRecord("a", fruit=fruit),),
        )
    )
    return [view.key for view in store.detections(round_key) if view.stop_key == key]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path / "house.db") as opened:
        for record in DAYS:
            opened.save_round(record)
        yield opened


def link(store: Store, first: str, last: str) -> None:
    """Link a fruit of a day with that of a later one, surely."""
    earlier, later = (store.detection(key).view.round_key for key in (first, last))
    store.save_growth(
        earlier, later, [records.LinkRecord(records.LinkKind.GROWTH, first, last, 1.0)]
    )


def compare(store: Store, *rounds: str) -> DayComparison:
    contents = [read_round(store, key) for key in rounds]
    first, last = contents[0], contents[-1]
    walked = {x.key: x.walked_s for x in store.rounds()}
    return compare_rounds(
        fruit_table(first),
        fruit_table(last),
        same_fruit(store, first, last),
        (first.stops, last.stops),
        (walked[last.key] - walked[first.key]) / DAY_S,
    )


def change_of(comparison: DayComparison, key: str) -> Change:
    [change] = [
        fruit.change
        for fruit in comparison.changes
        if key in {view.key for view in (fruit.before, fruit.after) if view is not None}
    ]
    return change


def test_the_demonstration_is_no_earlier_day_of_a_house_without_a_name(tmp_path: Path) -> None:
    with open_store(tmp_path / "unnamed.db") as store:
        for key, day in ((MONDAY, 0), (DEMONSTRATION, 1), (TUESDAY, 2)):
            store.save_round(records.Round(key, "round", "", NOON_S + day * DAY_S))
            fruit = (records.FruitRow(1, score=0.9, length=Length(0.1)),)
            taken_s = NOON_S + day * DAY_S
            capture = records.CaptureRecord("a", fruit=fruit)
            store.save_stop(
                records.StopRecord(
                    key=records.new_key(), round_key=key, taken_s=taken_s, captures=(capture,)
                )
            )
        assert [walk.key for walk in earlier_rounds(store, TUESDAY)] == [MONDAY]
        assert earlier_rounds(store, DEMONSTRATION) == []


def test_every_fruit_of_both_days_has_one_change(store: Store) -> None:
    grew, picked, gone = save_stop(
        store, MONDAY, 1.0, {-0.2: Length(0.10), 0.0: Length(0.20), 0.2: Length(0.15)}
    )
    grown, new = save_stop(store, TUESDAY, 1.0, {-0.2: Length(0.13), 0.1: Length(0.05)})
    link(store, grew, grown)
    store.pick([picked])
    comparison = compare(store, MONDAY, TUESDAY)
    changes = {key: change_of(comparison, key) for key in (grew, picked, gone, grown, new)}
    assert changes == {
        grew: Change.STAYED,
        grown: Change.STAYED,
        picked: Change.PICKED,
        gone: Change.GONE,
        new: Change.NEW,
    }
    places = comparison.before, comparison.after, comparison.number(Change.NOT_WALKED)
    assert places == (3, 2, 0)
    assert comparison.growth_m_per_day == pytest.approx(0.03, abs=1e-6)


def test_a_fruit_ticked_off_but_seen_again_is_still_on_the_plant(store: Store) -> None:
    [before] = save_stop(store, MONDAY, 1.0, {0.0: Length(0.10)})
    [after] = save_stop(store, TUESDAY, 1.0, {0.0: Length(0.12)})
    store.pick([before])
    link(store, before, after)
    comparison = compare(store, MONDAY, TUESDAY)
    assert change_of(comparison, after) is Change.STAYED
    assert (comparison.number(Change.PICKED), comparison.of(Change.STAYED)[0].is_back) == (0, True)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (Length(0.10), Length(0.12, LengthKind.BOX_CHORD)),
        (Length(0.10, LengthKind.SURFACE_CHORD), Length(0.12, LengthKind.SURFACE_CHORD)),
        (Length(0.10, LengthDefinition.CHORD), Length(0.12, LengthDefinition.THREAD)),
    ],
)
def test_lengths_that_mean_different_things_give_no_growth(
    store: Store, before: Length, after: Length
) -> None:
    [first] = save_stop(store, MONDAY, 1.0, {0.0: before})
    [last] = save_stop(store, TUESDAY, 1.0, {0.0: after})
    link(store, first, last)
    [fruit] = compare(store, MONDAY, TUESDAY).changes
    assert (fruit.change, fruit.growth_m_per_day) == (Change.STAYED, None)


@pytest.mark.parametrize("flags", ["end-hidden", "depth-sparse", "interval-too-wide"])
def test_a_length_that_is_a_bound_or_unknown_gives_no_growth(store: Store, flags: str) -> None:
    [first] = save_stop(store, MONDAY, 1.0, {0.0: Length(0.10)}, flags=flags)
    [last] = save_stop(store, TUESDAY, 1.0, {0.0: Length(0.12)})
    link(store, first, last)
    assert compare(store, MONDAY, TUESDAY).growth_m_per_day is None


def test_where_only_one_round_went_nothing_is_new_or_gone(store: Store) -> None:
    save_stop(store, MONDAY, 1.0, {0.0: Length(0.10)})
    [far] = save_stop(store, MONDAY, 5.0, {0.0: Length(0.10)})
    [other_row] = save_stop(store, MONDAY, 1.0, {0.0: Length(0.10)}, row="2")
    save_stop(store, TUESDAY, 1.0, {0.0: Length(0.10)})
    [later_row] = save_stop(store, TUESDAY, 1.0, {0.0: Length(0.10)}, row="10")
    comparison = compare(store, MONDAY, TUESDAY)
    assert {change_of(comparison, key) for key in (far, other_row, later_row)} == {
        Change.NOT_WALKED
    }
    assert list(comparison.by_row()) == ["1", "2", "10"]
    assert comparison.by_row()["2"].before == 0
    assert comparison.number(Change.NOT_WALKED) == 3


def test_a_row_without_positions_counts_as_walked(store: Store) -> None:
    [gone] = save_stop(store, MONDAY, 30.0, {0.0: Length(0.10)})
    save_stop(store, TUESDAY, None, {0.0: Length(0.10)})
    assert change_of(compare(store, MONDAY, TUESDAY), gone) is Change.GONE


def test_fruit_marked_as_no_fruit_are_left_out(store: Store) -> None:
    [pipe] = save_stop(store, MONDAY, 1.0, {0.0: Length(0.10)})
    save_stop(store, TUESDAY, 1.0, {0.0: Length(0.10)})
    store.set_verdict([pipe], records.Verdict.REJECTED)
    counts = compare(store, MONDAY, TUESDAY)
    assert (counts.before, counts.after) == (0, 1)


def test_a_link_that_is_not_sure_is_offered_and_counts_once_it_is_confirmed(store: Store) -> None:
    first = save_stop(store, MONDAY, 1.0, {0.0: Length(0.10), 0.3: Length(0.10)})
    last = save_stop(store, TUESDAY, 1.0, {0.0: Length(0.13), 0.3: Length(0.12)})
    scores = (0.6, 0.9)
    links = [
        records.LinkRecord(records.LinkKind.GROWTH, before, after, score)
        for before, after, score in zip(first, last, scores, strict=True)
    ]
    store.save_growth(MONDAY, TUESDAY, links)
    comparison = compare(store, MONDAY, TUESDAY)
    counts = comparison
    assert [counts.number(x) for x in (Change.STAYED, Change.NEW, Change.GONE)] == [1, 1, 1]
    contents = [read_round(store, key) for key in (MONDAY, TUESDAY)]
    [(before, after)] = offered_pairs(store, comparison, contents)
    assert (before.key, after.key) == (first[0], last[0])
    mark = store.decide_growth(before.key, after.key, same=True)
    assert compare(store, MONDAY, TUESDAY).number(Change.STAYED) == 2
    store.undo(number=mark)
    store.decide_growth(before.key, after.key, same=False)
    assert offered_pairs(store, compare(store, MONDAY, TUESDAY), contents) == []


def test_a_fruit_is_followed_through_the_days_between(store: Store) -> None:
    [monday] = save_stop(store, MONDAY, 1.0, {0.0: Length(0.10)})
    [tuesday] = save_stop(store, TUESDAY, 1.0, {0.0: Length(0.12)})
    [wednesday] = save_stop(store, WEDNESDAY, 1.0, {0.0: Length(0.16)})
    link(store, monday, tuesday)
    link(store, tuesday, wednesday)
    [fruit] = compare(store, MONDAY, TUESDAY, WEDNESDAY).changes
    assert fruit.growth_m_per_day == pytest.approx(0.03, abs=1e-6)
    days: list[list[records.FruitRow]] = [
        fruit_days(store, read_round(store, round_key), key)
        for round_key, key in ((MONDAY, monday), (TUESDAY, tuesday), (WEDNESDAY, wednesday))
    ]
    keys = [[view.key for view in views] for views in days]
    assert keys == [[monday, tuesday, wednesday]] * 3
    store.save_growth(MONDAY, TUESDAY, [])
    content = read_round(store, WEDNESDAY)
    assert [view.key for view in fruit_days(store, content, wednesday)] == [tuesday, wednesday]
    assert change_of(compare(store, MONDAY, TUESDAY, WEDNESDAY), monday) is Change.GONE
