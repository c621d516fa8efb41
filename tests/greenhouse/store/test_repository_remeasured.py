from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from cucumbervision.errors import StoreError
from cucumbervision.measurement.result import Length
from cucumbervision_greenhouse.store.corrections import StopPlace
from cucumbervision_greenhouse.store.links import LinkKind
from cucumbervision_greenhouse.store.records import DetectionRecord, StopRecord, key_of
from cucumbervision_greenhouse.store.views import Verdict

if TYPE_CHECKING:
    from tests.greenhouse.store.conftest import MakeStop

    from cucumbervision_greenhouse.store.repository import Store

WALK, NEXT_DAY = key_of("walk"), key_of("next day")


def with_fruit(stop: StopRecord, *lengths_m: float) -> StopRecord:
    """Return a stop with fruit of these lengths, numbered from 1."""
    fruit = tuple(DetectionRecord(k, length=Length(x)) for k, x in enumerate(lengths_m, 1))
    return replace(stop, captures=(replace(stop.captures[0], fruit=fruit),))


def test_fruit_that_are_the_same_keep_their_keys_and_what_was_said_of_them(
    store: Store, make_stop: MakeStop
) -> None:
    first, other = make_stop(1, fruit=3), make_stop(2, fruit=1)
    for one in (first, other):
        store.save_stop(one)
    gone, kept, corrected = (v.key for v in store.detections(WALK) if v.stop_key == first.key)
    [beside] = (v.key for v in store.detections(WALK) if v.stop_key == other.key)
    store.set_verdict([kept], Verdict.ACCEPTED)
    store.correct(corrected, replace(first.captures[0].fruit[2], length=Length(0.5)))
    store.merge(kept, beside)
    store.place_stop(first.key, StopPlace("4", "left", 2.0, 9))

    again = with_fruit(store.stop(first.key), 0.31, 0.32, 0.33)
    same = {kept: ("a", 1), corrected: ("a", 3)}
    store.signed("ana").measure_again(
        again, same, {corrected: DetectionRecord(3, length=Length(0.6))}
    )

    views = {v.key: v for v in store.detections(WALK) if v.stop_key == first.key}
    assert len(views) == 3
    assert gone not in views
    assert (views[kept].record.length_m, views[kept].verdict) == (0.31, Verdict.ACCEPTED)
    assert (views[corrected].record.length_m, views[corrected].corrected) == (0.6, True)
    [link] = store.links(WALK, LinkKind.SAME)
    assert {link.first, link.second} == {kept, beside}
    place = next(stop for stop in store.stops(WALK) if stop.key == first.key)
    assert (place.row, place.position_m, place.fruit) == ("4", 2.0, 3)
    assert store.stop(first.key) == replace(again, row="4", position_m=2.0, step=9)
    newest = store.log(WALK)[0]
    assert (newest.kind, newest.by, newest.details["gone"]) == ("measure-again", "ana", [gone])
    # The move before it is undone as ever, and the correction then gives way to what is measured.
    store.undo(WALK)
    store.undo(WALK)
    store.undo(WALK)
    assert store.detection(corrected).view.record.length_m == 0.33
    with pytest.raises(StoreError, match="undo"):
        store.undo(number=newest.number)


def test_what_is_measured_again_may_be_measured_again(store: Store, make_stop: MakeStop) -> None:
    stop = make_stop(1, fruit=2)
    store.save_stop(stop)
    for length_m in (0.31, 0.32):
        keys = [view.key for view in store.detections(WALK)]
        again = with_fruit(stop, length_m, 2 * length_m)
        store.measure_again(again, {keys[0]: ("a", 2)}, {})
    assert [view.record.length_m for view in store.detections(WALK)] == [0.32, 0.64]
    assert len(store.stops(WALK)) == 1


def test_a_deleted_stop_is_not_measured_again(store: Store, make_stop: MakeStop) -> None:
    stop = make_stop(1)
    store.save_stop(stop)
    store.delete_stop(stop.key)
    with pytest.raises(StoreError, match="is not in the store"):
        store.measure_again(stop, {}, {})
