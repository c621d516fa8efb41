"""Pages in Dutch and Spanish: none is left half in English, and a language is chosen at once."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from streamlit.testing.v1 import AppTest
from tests.greenhouse.pages.app_pages import PAGES, WALK, app, said, tables

from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse import language, resources

KINDS = ("button", "metric", "selectbox", "segmented_control", "number_input", "text_input")
SAME = {"Manual", "Camera", "Details"}  # words of both languages


def texts(test: AppTest) -> set[str]:
    """What a page says: texts, and labels of its elements."""
    labels = {str(part.label) for kind in KINDS for part in getattr(test, kind)}
    headings = {str(part.value) for part in [*test.header, *test.subheader, *test.title]}
    tabs = {str(part.label) for part in [*test.tabs, *test.expander]}
    columns = {name for lines in tables(test) for name in lines[0]}
    return {*said(test).splitlines(), *labels, *headings, *tabs, *columns} - {""}


@pytest.mark.usefixtures("fresh_caches")
@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("code", sorted(language.DRAFTS))
def test_nothing_of_a_page_is_left_in_english(code: str, page: str, house: Path) -> None:
    english = set(language.catalogue(code)._catalog) - SAME  # type: ignore[attr-defined]
    opened: dict[str, Any] = dict.fromkeys(("filters", "files", "stops"), True)
    drawn = texts(app(page, round=WALK, **opened))
    assert english & drawn  # in English they are those of the catalogue
    resources.change_settings(language=code)
    test = app(page, round=WALK, **opened)
    assert not test.exception
    kept = {text for text in english if language.catalogue(code).gettext(text) == text}
    assert not (english - kept) & texts(test)


@pytest.mark.usefixtures("fresh_caches")
def test_todays_page_in_dutch(house: Path) -> None:
    resources.change_settings(language="nl")
    test = app("today", round=WALK)
    labels = [metric.label for metric in test.metric]
    assert labels[:3] == ["Vandaag oogstbaar", "Zeker", "Misschien oogstbaar"]
    assert [heading.value for heading in test.header] == ["Oogstlijst"]
    lists = [x for x in test.get("bidi_component") if "fruitlist" in x.proto.component_name]
    says = [fruit["says"] for drawn in lists for fruit in json.loads(drawn.proto.json)["fruit"]]
    assert says
    assert {place.split(" m ")[1] for place, *_ in says} <= {"links", "rechts"}
    assert all(re.fullmatch(r"(minstens )?\d+,\d cm", length) for _, length, *_ in says)


def test_a_language_is_the_browsers_until_one_is_chosen(
    tmp_path: Path, start_server: Callable[..., str], new_page: Callable[..., Any]
) -> None:
    store = str(tmp_path / "house.db")
    address = start_server(tmp_path, "--store", store, "--replay", str(example_captures()))
    page = new_page(locale="es-MX")
    page.goto(f"{address}/settings")
    page.get_by_role("link", name="Ajustes").wait_for()
    page.goto(f"{address}/capture")
    page.get_by_role("button", name="Ronda nueva").wait_for()
    assert page.locator("html").get_attribute("lang") == "es"
    page.goto(f"{address}/settings")
    page.get_by_label("Idioma").click()
    page.get_by_role("option", name="Nederlands (concept)").click()
    page.get_by_role("link", name="Instellingen").wait_for()
    page.get_by_text("Gewas en eenheden").wait_for()
    page.goto(f"{address}/capture")
    page.get_by_role("button", name="Nieuwe ronde").wait_for()
    assert page.locator("html").get_attribute("lang") == "nl"
