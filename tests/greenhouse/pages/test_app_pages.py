from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

from streamlit.testing.v1 import AppTest
from tests.greenhouse.conftest import copy_round, whole_stop
from tests.greenhouse.pages.app_pages import LONG, PAGES, WALK, app, said, tables, wait_for_jobs

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision_greenhouse import language, resources, round_view
from cucumbervision_greenhouse.camera.page import walk
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION, round_for_capture
from cucumbervision_greenhouse.store.records import (
    LinkKind,
    LinkRecord,
    Round,
    StopRecord,
    Verdict,
    key_of,
    new_key,
)
from cucumbervision_greenhouse.store.repository import Store, open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")
ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("page", PAGES)
def test_every_page_opens_on_an_empty_store(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_STORE", str(tmp_path / "new" / "house.db"))
    test = app(page)
    assert not test.exception
    if page != "settings":
        assert "round" in said(test).lower()


def test_days_that_are_not_linked_are_no_change(house: Path) -> None:
    with open_store(house) as store:
        later = Round(new_key(), "next", "house 1", profile="long-cucumber")
        copy_round(store, later, 86400.0)
        first, last = (
            [view.key for view in store.detections(key) if view.best] for key in (WALK, later.key)
        )
    words = "No fruit of one day is surely one of the other"
    assert words in said(app("days", round=later.key))
    with open_store(house) as store:
        growth = LinkRecord(LinkKind.GROWTH, first[0], last[0], 1.0)
        store.save_growth(WALK, later.key, [growth])
        store.set_verdict(last[:1], Verdict.ACCEPTED)  # a mark, by which pages see a change
    assert words not in said(app("days", round=later.key))


@pytest.mark.parametrize(
    ("page", "part", "words"),
    [
        ("results", "fruit", "no such fruit"),
        ("row_map", "fruit", "no such fruit"),
        ("row_map", "stop", "no such stop"),
    ],
)
def test_an_address_of_no_fruit_or_stop_is_told(
    page: str, part: str, words: str, house: Path
) -> None:
    assert words in said(app(page, **{part: "![x](http://a)"}))


def test_every_page_counts_what_is_saved_of_its_round_alike(house: Path) -> None:
    empty = Round(key_of("empty"), "evening", "house 1")
    capture = next(iter(open_source(example_captures()))).load()
    with open_store(house) as store:
        store.save_round(empty)
        for number, key in enumerate([WALK, empty.key, empty.key, empty.key, WALK]):
            place = Stop("1", "left", 50.0 + number)
            waiting = replace(capture, stop=place, name=str(number))
            resources.waiting().put(waiting, key_of(number), key, 1_700_000_000.0 + number)
        busy = threading.Event()
        resources.worker().submit("Loading the networks", lambda _: busy.wait(600))
        told = "3 captures are saved, and none is measured yet"
        for page in ("today", "results"):
            words = said(app(page, round=empty.key))
            assert told in words
            assert "no stops yet" not in words
        walked = walk(store, empty.key, "camera")
        assert walked["first"].startswith(told)
        work = {"words": "Measuring: 0 of 3 captures; 2 captures of other rounds wait"}
        assert walked["work"] == round_view.news(empty.key)["work"]
        work["first"] = walked["first"]
        assert walked["work"] == {**work, "done": 0, "total": 3, "waiting": 3}
        assert "2 captures are still being measured" in said(app("today", round=WALK))
        assert round_view.news(WALK)["work"]["waiting"] == 2
        for one in resources.waiting().captures():
            resources.waiting().done(one)
        busy.set()
        wait_for_jobs()
        assert "no stops yet" in said(app("results", round=empty.key))
        assert walk(store, empty.key, "camera")["first"] == ""


def test_why_nothing_is_measured_is_told_on_every_page(house: Path, tmp_path: Path) -> None:
    lost = tmp_path / "lost.json"
    resources.change_settings(calibration=str(lost))
    capture = next(iter(open_source(example_captures()))).load()
    place = Stop("1", "left", 50.0)
    resources.waiting().put(replace(capture, stop=place), key_of("lost"), WALK, time.time())
    assert app("today", round=WALK).exception == []
    wait_for_jobs()
    words = round_view.news(WALK)["work"]["words"]
    assert words.startswith("1 capture waits to be measured: ")
    assert "lost.json" in words


def test_a_deleted_demonstration_comes_back_with_the_next_drawn_capture(store: Store) -> None:
    round_for_capture(store, WALK, simulated=True)
    store.delete_round(DEMONSTRATION)
    assert round_for_capture(store, WALK, simulated=True) == DEMONSTRATION
    assert DEMONSTRATION in {one.key for one in store.rounds()}


def test_every_page_opens_on_500_stops(
    house: Path, make_long: Callable[[Store, StopRecord, int], None]
) -> None:
    with open_store(house) as store:
        template = whole_stop(store, store.stops(WALK)[0].key)
        make_long(store, template, 500)
    for page in ("results", "row_map", "forecast", "accuracy"):
        test = app(page, round=LONG, source="replay")
        assert not test.exception
        if page == "results":
            assert next(m.value for m in test.metric if m.label == "Fruit") == "2500"
        if page == "row_map":
            [drawn] = [x for x in test.get("bidi_component") if "_row_" in x.proto.component_name]
            keys = re.findall('data-key="(.*?)"', json.loads(drawn.proto.json)["rows"])
            assert len(set(keys)) == len(keys) == 2500
            assert len(drawn.proto.json) < 480 * len(keys)


@pytest.mark.parametrize("page", ["results", "row_map", "forecast", "accuracy"])
def test_a_page_asks_once_whatever_the_number_of_its_fruit(
    page: str,
    house: Path,
    make_long: Callable[[Store, StopRecord, int], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with open_store(house) as store:
        make_long(store, whole_stop(store, store.stops(WALK)[0].key), 100)
    test = app(page, round=LONG)  # reads what is kept then
    asked: Counter[str] = Counter()
    read = Store.rounds

    def rounds(store: Store, *, deleted: bool = False) -> list[Round]:
        asked[f"for rounds, {deleted=}"] += 1
        return read(store, deleted=deleted)

    monkeypatch.setattr(Store, "rounds", rounds)
    assert not test.run().exception
    assert asked == {"for rounds, deleted=False": 1, "for rounds, deleted=True": 1}


def test_news_of_a_round_count_no_other(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = round_view.news(WALK)["version"]
    monkeypatch.delattr(Store, "rounds")  # every open page asks three times a second
    assert round_view.news(WALK)["version"] == before
    for missing in ("", "no key", new_key()):
        assert round_view.news(missing)["version"].endswith("-0")


def test_the_first_page_needs_neither_tables_nor_charts_nor_networks(
    house: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A viewer waits for what a new process imports."""
    monkeypatch.setenv("CUCUMBERVISION_LOGIN", "none")
    code = (
        "import sys\n"
        "from streamlit.testing.v1 import AppTest\n"
        "from cucumbervision_greenhouse import resources\n"
        "from cucumbervision_greenhouse.pages import app\n"
        "test = AppTest.from_file(app.__file__, default_timeout=600).run()\n"
        "assert not test.exception and not test.error\n"
        "assert 'Pick list' in [heading.value for heading in test.header]\n"
        "assert not resources.worker().unfinished()\n"
        "late = ('pandas', 'pyarrow', 'altair', 'scipy.stats', 'onnxruntime', 'openvino',\n"
        "        'pydeck', 'streamlit.emojis')\n"
        "print(*[name for name in late if name in sys.modules])\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == ""


@pytest.mark.parametrize("offer", ["https://git.example/ours", "ask at the office"])
def test_the_source_is_offered(offer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUCUMBERVISION_SOURCE", offer)
    test = app("app", "about")
    assert "AGPL-3.0-only" in said(test)
    links = [one.proto.url for one in test.get("link_button")]
    assert links == [offer] if offer.startswith("http") else offer in said(test)


KINDS = ("button", "metric", "selectbox", "segmented_control", "number_input", "text_input")
SAME = {"Manual", "Camera", "Details"}  # words of both languages


def texts(test: AppTest) -> set[str]:
    """What a page says: texts, and labels of its elements."""
    labels = {str(part.label) for kind in KINDS for part in getattr(test, kind)}
    headings = {str(part.value) for part in [*test.header, *test.subheader, *test.title]}
    tabs = {str(part.label) for part in [*test.tabs, *test.expander]}
    columns = {name for lines in tables(test) for name in lines[0]}
    return {*said(test).splitlines(), *labels, *headings, *tabs, *columns} - {""}


@pytest.mark.parametrize("page", PAGES)
def test_nothing_of_a_page_of_a_round_is_left_in_english(page: str, house: Path) -> None:
    opened: dict[str, Any] = dict.fromkeys(("filters", "files", "stops"), True)
    test = app(page, round=WALK, **opened)
    assert not test.exception
    drawn = texts(test)
    for code in sorted(language.LANGUAGES.keys() - {"en"}):
        english = set(language.catalogue(code)._catalog) - SAME  # type: ignore[attr-defined]
        assert english & drawn  # in English they are those of the catalogue
        resources.change_settings(language=code)
        test = app(page, round=WALK, **opened)
        assert not test.exception
        kept = {text for text in english if language.catalogue(code).gettext(text) == text}
        assert not (english - kept) & texts(test)


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
