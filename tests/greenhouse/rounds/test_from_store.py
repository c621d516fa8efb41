from __future__ import annotations

import pytest
from tests.greenhouse.rounds.conftest import MORNING

from cucumbervision.errors import RoundError
from cucumbervision_greenhouse.rounds.from_store import find_round
from cucumbervision_greenhouse.store.records import (
    Round,
)
from cucumbervision_greenhouse.store.repository import Store


def test_rounds_are_found_by_name(store: Store) -> None:
    assert find_round(store).key == find_round(store, "morning").key == MORNING.key
    assert find_round(store, MORNING.key[:6]).key == MORNING.key
    with pytest.raises(RoundError, match="no round is called 'evening'"):
        find_round(store, "evening")


def test_a_number_is_never_the_start_of_a_rounds_key(store: Store) -> None:
    key = "2aaaaaaa-0000-4000-8000-000000000000"
    store.save_round(Round(key, "Tuesday"))
    assert find_round(store, "2aa").key == key
    with pytest.raises(RoundError, match="no round is called '2'"):
        find_round(store, "2")
