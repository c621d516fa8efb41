from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.pages.app_pages import WALK, app, said, tap

from cucumbervision_greenhouse.store.records import Verdict
from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


@pytest.mark.parametrize("page", ["results", "row_map"])
def test_undo_leaves_what_another_viewer_did_since(page: str, house: Path) -> None:
    with open_store(house) as store:
        mine, other = (one.key for one in store.detections(WALK)[:2])
        tap(app("results", fruit=mine), "Not a fruit")
        store.signed("dashboard", "another browser").set_verdict([other], Verdict.REJECTED)
        test = app(page, fruit=mine)
        tap(test, "Undo")
        rejected = [x.key for x in store.detections(WALK) if x.verdict is Verdict.REJECTED]
        assert rejected == [other]
        assert test.toast[0].value.replace("\\", "") == "Taken back: not a fruit"
        tap(test, "Undo")
        assert "Nothing to undo" in said(test)
        assert [x.key for x in store.detections(WALK) if x.verdict is Verdict.REJECTED] == [other]
