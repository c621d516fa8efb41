from __future__ import annotations

import pytest
from tests.greenhouse.store.conftest import MakeStop

from cucumbervision.errors import NameRefusedError, StoreConflictError, StoreError
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.repository import Store

WALK, NEXT_DAY = records.key_of("walk"), records.key_of("next day")


def placed(
    key: str,
    row: str | None,
    side: str | None,
    position_m: float | None,
    step: int | None,
    note: str = "",
    mirrored: bool = False,
) -> records.StopRecord:
    return records.StopRecord(row, side, position_m, step, key, WALK, note=note, mirrored=mirrored)


@pytest.fixture
def stops(store: Store, make_stop: MakeStop) -> list[str]:
    """Two stops with two fruit each, at 0.4 and 0.8 m of row 3."""
    for step in (1, 2):
        store.save_stop(make_stop(step))
    return [stop.key for stop in store.stops(WALK)]


def test_a_stop_is_moved_and_its_fruit_with_it(store: Store, stops: list[str]) -> None:
    store.save_merging(WALK, [], {stops[0]: (0.45, 0.01), stops[1]: (0.8, 0.01)})
    store.signed("ana").place_stop(placed(stops[0], "4", "left", 2.0, 9, "the long leaf"))
    moved, other = store.stops(WALK)
    assert (moved.row, moved.position_m, moved.fitted_m) == ("4", 2.0, None)
    assert (moved.step, moved.note) == (9, "the long leaf")
    assert other.fitted_m == 0.8  # only the stop that was moved has to be found anew
    views = store.detections(WALK)
    # Fruit k hangs 0.1 k m along from its stop.
    assert [round(view.along_m or 0, 3) for view in views if view.stop_key == stops[0]] == [
        2.1,
        2.2,
    ]
    assert {view.row for view in views if view.stop_key == stops[0]} == {"4"}
    store.undo(WALK)
    assert [(stop.row, stop.position_m, stop.step) for stop in store.stops(WALK)] == [
        ("3", 0.4, 1),
        ("3", 0.8, 2),
    ]
    assert store.log(WALK)[1].by == "ana"


def test_fruit_of_a_mirrored_stop_lie_on_the_other_side_of_it(
    store: Store, stops: list[str]
) -> None:
    pose = store.stops(WALK)[0].pose_now
    store.place_stop(placed(stops[0], "3", "right", 0.4, 1, mirrored=True))
    along = [round(v.along_m or 0, 3) for v in store.detections(WALK) if v.stop_key == stops[0]]
    assert along == [0.3, 0.2]
    turned = store.stops(WALK)[0].pose_now
    assert list(turned) == [*(-x for x in pose[:3]), *pose[3:]]


def test_a_deleted_stop_is_in_no_list_and_comes_back(store: Store, stops: list[str]) -> None:
    keys = [view.key for view in store.detections(WALK)]
    store.save_merging(WALK, [records.LinkRecord(records.LinkKind.SAME, keys[0], keys[2], 0.9)])
    before = store.stops(WALK), store.detections(WALK), store.links(WALK), store.rounds()
    store.delete_stop(stops[1])
    assert [stop.key for stop in store.stops(WALK)] == stops[:1]
    assert [view.key for view in store.detections(WALK)] == keys[:2]
    assert store.links(WALK) == []
    assert [(one.stops, one.fruit) for one in store.rounds() if one.key == WALK] == [(1, 2)]
    with pytest.raises(StoreError, match="is not in the store"):
        store.pick([keys[2]])
    with pytest.raises(StoreError, match="is not in the store"):
        store.delete_stop(stops[1])
    assert store.undo(number=store.log(WALK)[-1].number)
    assert (store.stops(WALK), store.detections(WALK), store.links(WALK), store.rounds()) == before


def test_a_deleted_stop_that_is_sent_again_stays_deleted(
    store: Store, stops: list[str], make_stop: MakeStop
) -> None:
    store.delete_stop(stops[0])
    assert not store.save_stop(make_stop(1))
    assert [stop.key for stop in store.stops(WALK)] == stops[1:]
    gone = [store.stop_is_deleted(key) for key in (*stops, records.key_of("nowhere"))]
    assert gone == [True, False, None]
    with pytest.raises(StoreError, match="has no capture"):
        store.add_fruit(stops[0], "a", records.FruitRow(1))


def test_an_edit_on_which_another_stands_is_undone_after_it(store: Store, stops: list[str]) -> None:
    first = store.place_stop(placed(stops[0], "3", "left", 1.0, 1))
    second = store.place_stop(placed(stops[0], "3", "left", 1.5, 1))
    with pytest.raises(StoreConflictError, match="undo the later change first"):
        store.undo(number=first)
    assert [stop.position_m for stop in store.stops(WALK)] == [1.5, 0.8]
    store.undo(number=second)
    store.undo(number=first)
    assert [stop.position_m for stop in store.stops(WALK)] == [0.4, 0.8]


def test_rounds_move_to_another_house_and_back(store: Store, stops: list[str]) -> None:
    assert len(stops) == 2
    both = [WALK, NEXT_DAY]
    assert {one.house for one in store.rounds()} == {"house 1"}
    assert store.move_rounds(both, "North") == 2
    assert store.move_rounds(both, "North") == 0
    store.save_round(records.Round(records.key_of("south"), "south", "House South", 1000.0))
    # Another spelling of a house means that house; of its own it is a new spelling.
    assert store.move_rounds([WALK], "south") == 1
    assert store.move_rounds([NEXT_DAY], "house north") == 1
    house = {one.key: one.house for one in store.rounds()}
    assert (house[WALK], house[NEXT_DAY]) == ("House South", "house north")
    store.undo(WALK)
    store.undo(WALK)
    assert {one.key: one.house for one in store.rounds()}[WALK] == "house 1"
    with pytest.raises(NameRefusedError):
        store.move_rounds(both, "a\u202eb")
    assert check_store(store).sound


def test_a_round_is_renamed_deleted_and_brought_back(store: Store, stops: list[str]) -> None:
    assert len(stops) == 2
    store.rename_round(WALK, "evening")
    assert [one.name for one in store.rounds()] == ["next morning", "evening"]
    # Who began it may still send it under its first name.
    assert not store.save_round(records.Round(WALK, "morning", "house 1", 1000.0))
    store.delete_round(WALK)
    assert [one.key for one in store.rounds()] == [NEXT_DAY]
    assert [one.key for one in store.rounds(deleted=True)] == [WALK]
    store.restore_round(WALK)
    assert [(one.key, one.stops) for one in store.rounds()] == [(NEXT_DAY, 0), (WALK, 2)]
    store.undo(WALK)
    assert [one.name for one in store.rounds()] == ["next morning", "morning"]
    with pytest.raises(StoreError, match="is not deleted"):
        store.restore_round(WALK)
    with pytest.raises(StoreError, match="is not in the store"):
        store.rename_round(records.key_of("nowhere"), "x")
