"""The login of a real server, in a real browser: by the token, and through a proxy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("playwright")

from tests.greenhouse.conftest import WALK

from cucumbervision.capture.source import example_captures
from cucumbervision.methods.result import MethodName
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.store.repository import open_store

TOKEN = "a-token-of-this-test-only"

NewPage = Callable[[], Any]
StartServer = Callable[..., str]


def links(page: Any) -> Any:
    """The links to the pages, which only who is logged in sees."""
    return page.locator(".st-key-nav a")


def test_only_the_link_with_the_token_opens_the_pages(
    start_server: StartServer, new_page: NewPage, tmp_path: Path
) -> None:
    variables = {"CUCUMBERVISION_TOKEN": TOKEN, "HOME": str(tmp_path)}
    address = start_server(tmp_path, "--login", "--store", str(tmp_path / "house.db"), **variables)
    page = new_page()
    for path in ("", "/capture", "/_stcore/health", "/?token=wrong"):
        assert page.goto(address + path).status == 403
    form = {"file": {"name": "a.png", "mimeType": "image/png", "buffer": b"x"}}
    upload = f"{address}/_stcore/upload_file/invented/1"
    assert page.request.put(upload, multipart=form).status == 403
    page.goto(f"{address}/settings?token={TOKEN}")
    links(page).first.wait_for()
    assert "token" not in page.url
    # The cookie admits this browser from now on, and no other.
    page.goto(address)
    links(page).first.wait_for()
    assert new_page().goto(address).status == 403


def test_who_comes_through_a_proxy_signs_the_changes(
    start_server: StartServer, new_page: NewPage, tmp_path: Path
) -> None:
    path = tmp_path / "house.db"
    with open_store(path) as store:
        store.save_round(WALK)
        options = MeasureOptions(instances="dataset", segmenter="none", methods=(MethodName.M1,))
        add_captures(store, WALK.key, [example_captures() / "simulated-row-b"], options)
    variables = {"CUCUMBERVISION_TOKEN": TOKEN, "HOME": str(tmp_path)}
    address = start_server(tmp_path, "--login", "--store", str(path), **variables)
    page = new_page()
    page.set_extra_http_headers(
        {"Authorization": f"Bearer {TOKEN}", "X-Forwarded-Email": "anna@example.org"}
    )
    page.goto(f"{address}/results?round={WALK.key}")
    page.locator(".fruit button").first.click()
    page.locator("[class*='st-key-accepted_'] button").click()
    with open_store(path, create=False) as store:
        while not store.log(WALK.key):
            page.wait_for_timeout(100)
        assert {action.by for action in store.log(WALK.key)} == {"anna@example.org"}
