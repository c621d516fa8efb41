from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import WALK, app, said

from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_the_row_map_shows_the_fruit_in_the_address_and_says_which_is_gone(house: Path) -> None:
    with open_store(house) as store:
        first, *_ = store.detections(WALK)
    test = app("row_map", round=WALK, fruit=first.key)
    assert not test.exception
    assert "true size" in said(test)
    assert "no such fruit" not in said(test)
    assert "no such fruit" in said(app("row_map", round=WALK, fruit="gone"))
