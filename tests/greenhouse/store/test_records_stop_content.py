from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision_greenhouse.store.records import Saved, StopRecord, key_of, new_key
from cucumbervision_greenhouse.store.repository import Store

if TYPE_CHECKING:
    from tests.greenhouse.store.conftest import MakeStop


WALK = key_of("walk")


def test_a_stop_comes_back_as_it_was_sent(store: Store, make_stop: MakeStop) -> None:
    stop = make_stop(3, pose=tuple(float(x) for x in range(16)), note="=1+1 'quoted' ž\n")
    assert store.save_stop(stop) is Saved.NEW
    assert store.stop(stop.key) == stop


def test_a_stop_with_nothing_in_it_comes_back_too(store: Store) -> None:
    stop = StopRecord(new_key(), WALK)
    store.save_stop(stop)
    assert store.stop(stop.key) == stop
    [view] = store.stops(WALK)
    assert (view.row, view.captures, view.fruit, view.thumbnail) == (None, (), 0, None)
