from __future__ import annotations

from pathlib import Path

import pytest
from tests.greenhouse.pages.app_pages import WALK, app, said

from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import LinkKind, LinkRecord
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.words import length_words

pytestmark = pytest.mark.usefixtures("fresh_caches")


def lines_of(fruit_key: str) -> list[str]:
    return said(app("results", round=WALK, fruit=fruit_key)).splitlines()


def test_a_fruit_shows_its_views_and_the_length_of_all_together(house: Path) -> None:
    with open_store(house) as store:
        first, second, alone, *_ = store.detections(WALK)
        store.save_merging(WALK, [LinkRecord(LinkKind.SAME, first.key, second.key, 1.0)])
        seen = [view for view in store.detections(WALK) if view.views == 2]
        best = next(view for view in seen if view.best)
        (line,) = (x for x in fruit_table(read_round(store, WALK)) if x.key == best.key)
    lines = lines_of(best.key)
    assert "**Seen 2 times**" in lines
    for view in seen:
        words = f"Stop {view.step}: {length_words(view, Units('cm'))}"
        assert any(one.startswith(words) for one in lines), (words, lines)
    together = length_words(line, Units("cm"))
    assert any(one.startswith(f"All that show it whole, together: {together}") for one in lines)
    assert not any(one.startswith("All that show it whole") for one in lines_of(alone.key))
