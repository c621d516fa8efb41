from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from cucumbervision.errors import RoundError
from cucumbervision.rounds.service import link_rounds
from cucumbervision.rounds.settling import settle, undo
from cucumbervision.store.edits import StopPlace
from cucumbervision.store.records import key_of
from cucumbervision_lab.simulation import SimulatedRow, simulate_row

if TYPE_CHECKING:
    from tests.rounds.conftest import SaveWalk

    from cucumbervision.store.repository import Store

MORNING = key_of("rounds", "morning")


@pytest.fixture
def stops(store: Store, save_walk: SaveWalk) -> list[str]:
    """A small simulated row."""
    save_walk(simulate_row(SimulatedRow(fruit=12), 1))
    return [one.key for one in store.stops(MORNING)]


def test_a_stop_that_is_deleted_meanwhile_is_a_fault_in_words(
    store: Store, stops: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save, links = store.save_merging, []

    def deleted_before(key: str, found: list[object], positions: object) -> int:
        links.extend(found)
        for stop in stops:
            store.delete_stop(stop)
        return save(key, found, positions)  # type: ignore[arg-type]

    monkeypatch.setattr(store, "save_merging", deleted_before)
    said = settle(store, MORNING)
    assert links
    assert "is not in the store" in said


def test_a_round_that_is_deleted_meanwhile_is_named(store: Store) -> None:
    one = next(one.record for one in store.rounds())
    later = replace(one, key=key_of("later"), started_s=one.started_s + 86400.0)
    store.save_round(later)
    store.delete_round(later.key)
    with pytest.raises(RoundError, match=f"there is no round {later.key}"):
        link_rounds(store, MORNING, later.key)


def test_undoing_tells_of_which_round_a_stop_was_moved(store: Store, stops: list[str]) -> None:
    store.place_stop(stops[0], StopPlace("3", "left", 1.0, 1))
    store.pick([store.detections(MORNING)[0].key])
    assert undo(store, MORNING) == (3, "")
    assert undo(store, MORNING, by="kim") == (4, MORNING)
    assert store.log(MORNING)[0].by == "kim"
