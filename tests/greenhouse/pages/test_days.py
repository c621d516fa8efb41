from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from tests.greenhouse.conftest import whole_stop

pytest.importorskip("streamlit")

from tests.greenhouse.pages.app_pages import WALK, app, said, tap

from cucumbervision_greenhouse.store.records import LinkKind, LinkRecord, Round, new_key
from cucumbervision_greenhouse.store.repository import open_store


@pytest.mark.usefixtures("fresh_caches")
def test_a_pair_that_may_be_one_fruit_is_offered_until_it_is_confirmed(house: Path) -> None:
    with open_store(house) as store:
        [walk] = [x for x in store.rounds() if x.key == WALK]
        later = Round(name="later", house="house 1", started_s=walk.walked_s + 86400.0)
        store.save_round(later)
        for x in (whole_stop(store, x.key) for x in store.stops(WALK)):
            store.save_stop(replace(x, key=new_key(), round_key=later.key, taken_s=later.started_s))
        first, second = (store.detections(key)[0].key for key in (WALK, later.key))
        store.save_growth(WALK, later.key, [LinkRecord(LinkKind.GROWTH, first, second, 0.7)])
    test = app("days", round=later.key)
    new = int({x.label: x.value for x in test.metric}["New"])
    assert "1 pair may be one fruit" in said(test)
    tap(test, "The same fruit")
    assert "may be one fruit" not in said(test)
    assert {x.label: x.value for x in test.metric}["New"] == str(new - 1)
    tap(test, "Undo")
    assert "1 pair may be one fruit" in said(test)
