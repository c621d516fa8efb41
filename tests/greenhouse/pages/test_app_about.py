from __future__ import annotations

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import app, said

pytestmark = pytest.mark.usefixtures("fresh_caches")


@pytest.mark.parametrize("offer", ["https://git.example/ours", "ask at the office"])
def test_the_source_is_offered(offer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUCUMBERVISION_SOURCE", offer)
    test = app("app", "about")
    assert "AGPL-3.0-only" in said(test)
    links = [one.proto.url for one in test.get("link_button")]
    assert links == [offer] if offer.startswith("http") else offer in said(test)
