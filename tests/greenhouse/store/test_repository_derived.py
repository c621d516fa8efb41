from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import pytest

from cucumbervision_greenhouse.store.records import LinkKind, LinkRecord, Round, key_of
from cucumbervision_greenhouse.store.repository import Store

if TYPE_CHECKING:
    from tests.greenhouse.store.conftest import MakeStop

WALK, NEXT_DAY = key_of("walk"), key_of("next day")


@pytest.fixture
def keys(store: Store, make_stop: MakeStop) -> list[str]:
    """Two fruit at each of two stops, and the next day again."""
    for walk in (Round(WALK, started_s=1000.0), Round(NEXT_DAY, started_s=87400.0)):
        for step in (1, 2):
            store.save_stop(make_stop(step, round=walk))
    return [detection.key for walk in (WALK, NEXT_DAY) for detection in store.detections(walk)]


def same(first: str, second: str, score: float | None = None) -> LinkRecord:
    return LinkRecord(LinkKind.SAME, first, second, score)


def test_each_run_replaces_what_the_last_one_said(store: Store, keys: list[str]) -> None:
    stop = key_of(WALK, 2)
    store.save_merging(WALK, [same(keys[0], keys[2], 0.7)], {stop: (0.77, 0.01)})
    assert store.links(WALK) == [same(keys[0], keys[2], 0.7)]
    view = store.stops(WALK)[1]
    assert (view.position_m, view.fitted_m, view.fitted_sd_m) == (0.8, 0.77, 0.01)
    fruit = store.detections(WALK)[2]
    assert fruit.along_m == pytest.approx(0.77 + 0.1)
    assert fruit.along_sd_m == pytest.approx(hypot(0.01, 0.03))
    store.save_merging(WALK, [same(keys[1], keys[2])])
    assert store.links(WALK) == [same(keys[1], keys[2])]
    assert store.stops(WALK)[1].fitted_m is None
    # What was sent is as it was.
    assert store.stop(stop).position_m == 0.8


def test_growth_between_two_rounds(store: Store, keys: list[str]) -> None:
    growth = [LinkRecord(LinkKind.GROWTH, keys[k], keys[k + 4], 0.9) for k in (0, 1)]
    store.save_merging(WALK, [same(keys[0], keys[2])])
    store.save_growth(WALK, NEXT_DAY, growth)
    assert store.links(NEXT_DAY) == growth
    assert store.links(WALK, LinkKind.SAME) == [same(keys[0], keys[2])]
    store.save_growth(WALK, NEXT_DAY, growth[:1])
    assert store.links(NEXT_DAY) == growth[:1]
    # A new merging leaves growth alone.
    store.save_merging(WALK, [])
    assert store.links(WALK) == growth[:1]
