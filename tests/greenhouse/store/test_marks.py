from __future__ import annotations

from typing import Any

import pytest
from tests.greenhouse.store.conftest import MakeStop

from cucumbervision.errors import NameRefusedError, StoreConflictError, StoreError
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.marks import round_id_of, write_mark
from cucumbervision_greenhouse.store.records import (
    FruitRow,
    LinkKind,
    LinkRecord,
    Round,
    Verdict,
    key_of,
    new_key,
)
from cucumbervision_greenhouse.store.repository import Store

WALK, NEXT_DAY = key_of("walk"), key_of("next day")


@pytest.fixture
def keys(store: Store, make_stop: MakeStop) -> list[str]:
    """Four detections: two stops with two fruit each."""
    for step in (1, 2):
        store.save_stop(make_stop(step))
    return [detection.key for detection in store.detections(WALK)]


def said(store: Store) -> list[Any]:
    """Everything that can be changed by hand."""
    return [(detection, store.links(WALK)) for detection in store.detections(WALK)]


def group(store: Store, key: str) -> set[str]:
    views = store.detections(WALK)
    best = next(view.group for view in views if view.key == key)
    return {view.key for view in views if view.group == best}


def test_a_verdict_is_given_changed_and_taken_away(store: Store, keys: list[str]) -> None:
    store.signed("ana").set_verdict(keys[:2], Verdict.ACCEPTED)
    store.signed("bo").set_verdict(keys[1:3], Verdict.REJECTED)
    store.signed("bo").set_verdict(keys[2:3], None)
    assert [detection.verdict for detection in store.detections(WALK)] == [
        Verdict.ACCEPTED,
        Verdict.REJECTED,
        None,
        None,
    ]
    log = [(line.kind, line.by, line.fruit) for line in store.log(WALK)]
    assert log == [
        ("clear", "bo", (keys[2],)),
        ("reject", "bo", (keys[1], keys[2])),
        ("accept", "ana", (keys[0], keys[1])),
    ]
    assert store.log(NEXT_DAY) == []
    assert [line.kind for line in store.log(limit=1)] == ["clear"]


@pytest.mark.parametrize(
    "act",
    [
        lambda s, k: s.set_verdict(k, Verdict.REJECTED),
        lambda s, k: s.set_verdict(k, None),
        lambda s, k: s.pick(k, at_s=9.0),
        lambda s, k: s.unpick(k),
        lambda s, k: s.correct(k[0], FruitRow(1, length=Length(0.5))),
    ],
    ids=["reject", "clear", "pick", "unpick", "correct"],
)
def test_every_action_can_be_taken_back(store: Store, keys: list[str], act: Any) -> None:
    store.set_verdict(keys[:2], Verdict.ACCEPTED)
    store.pick(keys[:1], at_s=4.0)
    store.correct(keys[0], FruitRow(1, length=Length(0.4)))
    store.save_merging(WALK, [LinkRecord(LinkKind.SAME, keys[1], keys[2], 0.8)])
    before = said(store)
    act(store, keys)
    assert said(store) != before
    store.signed("ana").undo(WALK)
    assert said(store) == before
    done, undone = store.log(WALK)[0], store.log(WALK)[1]
    assert (done.kind, done.by, done.undone) == ("undo", "ana", False)
    assert undone.undone


def test_an_earlier_mark_is_taken_back_under_a_later_one(store: Store, keys: list[str]) -> None:
    first = store.set_verdict(keys[:1], Verdict.ACCEPTED)
    other = store.set_verdict(keys[1:2], Verdict.ACCEPTED)
    store.set_verdict(keys[:1], Verdict.REJECTED)
    for number in (first, other):
        store.undo(number=number)
    assert [fruit.verdict for fruit in store.detections(WALK)[:2]] == [Verdict.REJECTED, None]
    for number in (other, store.log(WALK)[0].number):
        with pytest.raises(StoreError, match=f"no mark {number}"):
            store.undo(number=number)
    store.undo(WALK)
    assert store.detections(WALK)[0].verdict is None


def test_undo_is_of_the_round_that_was_named(store: Store, make_stop: MakeStop) -> None:
    walks = (Round(key_of("walk"), started_s=1000.0), Round(NEXT_DAY))
    for walk in walks:
        store.save_stop(make_stop(1, round=walk))
    for walk in walks:
        store.set_verdict([store.detections(walk.key)[0].key], Verdict.ACCEPTED)
    store.undo(WALK)
    assert store.detections(WALK)[0].verdict is None
    assert store.detections(NEXT_DAY)[0].verdict is Verdict.ACCEPTED


def test_a_corrected_fruit_stands_for_the_first_which_is_kept(
    store: Store, keys: list[str]
) -> None:
    original = store.detection(keys[1]).view
    corrected = original.with_(length=Length(0.333), mask="45", offset_m=0.7, flags="by-hand")
    store.signed("ana").correct(keys[1], corrected)
    detail = store.detection(keys[1])
    assert (detail.view.cells, detail.view.shape) == (corrected.cells, corrected.shape)
    assert [line.kind for line in detail.log] == ["correct"]
    listed = store.detections(WALK)[1]
    assert listed.corrected
    assert (listed.cells, listed.mask) == (corrected.cells, None)
    assert listed.along_m == pytest.approx(0.4 + 0.7)


def test_links_by_hand_of_earlier_versions_hold_until_they_are_taken_back(
    store: Store, keys: list[str]
) -> None:
    a, b, c, d = keys

    def mark(kind: str, *fruit: str, **details: Any) -> int:
        with store.writing() as connection:
            walk = round_id_of(connection, WALK)
            return write_mark(connection, kind, walk, fruit, {"rounds": [walk], **details})

    parted = mark("unmerge", c, a, b)
    around = [LinkRecord(LinkKind.SAME, *pair, 0.9) for pair in ((a, b), (b, d), (d, c), (b, c))]
    store.save_merging(WALK, around)
    assert c not in group(store, a)
    merged = mark("merge", c, a, ends=[[c, a], [c, b]])
    assert group(store, c) == {a, b, c, d}
    for number in (merged, parted):
        store.undo(number=number)
    assert group(store, a) == {a, b, c, d}


def test_the_best_view_of_a_fruit_represents_it(store: Store, keys: list[str]) -> None:
    a, b, c, d = keys
    store.save_merging(WALK, [LinkRecord(LinkKind.SAME, a, c, 0.9)])
    store.correct(c, FruitRow(1, length=Length(0.2), view_score=0.9))

    def shown() -> list[FruitRow]:
        return [view for view in store.detections(WALK) if view.best]

    assert [(one.key, one.views) for one in shown()] == [(b, 1), (c, 2), (d, 1)]
    # A rejected view does not stand, and a pick counts for every view.
    store.set_verdict([c], Verdict.REJECTED)
    store.pick([c], at_s=7.0)
    assert [(one.key, one.picked_s) for one in shown()] == [(a, 7.0), (b, None), (d, None)]
    with pytest.raises(StoreError, match="is not in the store"):
        store.pick([new_key()])
    with pytest.raises(StoreError, match="no fruit was named"):
        store.pick([])


def test_a_fruit_added_by_hand_is_a_fruit_like_others_until_it_is_taken_back(
    store: Store, keys: list[str]
) -> None:
    before, stop = said(store), key_of(WALK, 1)
    record = FruitRow(1, mask="abc", length=Length(0.3), mask_source="sam")
    added = store.signed("ana").add_fruit(stop, "a", record)
    *_, view = (detection for detection in store.detections(WALK) if detection.stop_key == stop)
    assert (view.key, view.fruit, view.verdict) == (added, 3, Verdict.ACCEPTED)
    shaped = store.detection(added).view
    assert (shaped.cells, shaped.shape) == (record.with_(fruit=3).cells, record.shape)
    assert [one.fruit for one in store.rounds() if one.key == WALK] == [5]
    assert [one.fruit for one in store.stops(WALK)] == [3, 2]
    assert [(line.kind, line.by) for line in store.log(WALK)] == [("add", "ana")]
    store.undo(WALK)
    assert said(store) == before
    assert [one.fruit for one in store.stops(WALK)] == [2, 2]
    for ask in (store.detection, lambda key: store.pick([key])):
        with pytest.raises(StoreError, match="is not in the store"):
            ask(added)
    second_key = store.add_fruit(stop, "a", record)
    assert store.detection(second_key).view.fruit == 4


def test_a_fruit_can_be_added_to_a_capture_without_any(store: Store, make_stop: MakeStop) -> None:
    store.save_stop(make_stop(1, fruit=0))
    store.add_fruit(key_of(WALK, 1), "a", FruitRow(9))
    assert [detection.fruit for detection in store.detections(WALK)] == [1]
    with pytest.raises(StoreError, match="has no capture 'b'"):
        store.add_fruit(key_of(WALK, 1), "b", FruitRow(1))


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
