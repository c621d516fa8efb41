from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import WALK, app, tap

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse.rounds.merge_and_link import move_stop
from cucumbervision_greenhouse.store.repository import Store, open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_undo_on_a_fruit_s_page_takes_a_deleted_stop_back_and_merges(house: Path) -> None:
    with open_store(house) as store:
        stop = store.stops(WALK)[0]
        fruit = next(one for one in store.detections(WALK) if one.stop_key != stop.key)
        store.delete_stop(stop.key)
        for page in ("results", "row_map"):
            test = app(page, round=WALK, fruit=fruit.key)
            tap(test, "Undo")
            put_back = store.stops(WALK)[0]
            assert put_back.key == stop.key
            assert put_back.fitted_m is not None
            store.place_stop(replace(stop, position_m=9.0, step=1))


def test_fruit_turn_with_the_side_of_their_stop(store: Store) -> None:
    first = store.stops(WALK)[0]
    at_m = first.position_m or 0.0

    def offsets() -> list[float]:
        views = [view for view in store.detections(WALK) if view.stop_key == first.key]
        return [round((view.along_m or 0.0) - at_m, 6) for view in views]

    before = offsets()
    other = "left" if first.side == "right" else "right"
    move_stop(store, first, Stop(first.row, other, first.position_m, first.step))
    assert offsets() == [-x for x in before]
    turned = store.stops(WALK)[0]
    move_stop(store, turned, Stop(first.row, first.side, first.position_m, first.step))
    assert offsets() == before
