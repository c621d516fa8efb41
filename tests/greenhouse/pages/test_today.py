from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import pytest
from tests.greenhouse.conftest import whole_stop

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import WALK, app, said, wait_for_jobs

from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.rounds.walking import DEMONSTRATION, round_for_capture
from cucumbervision_greenhouse.store.records import Round, new_key
from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_the_example_says_that_it_is_being_measured(house: Path) -> None:
    with open_store(house) as store:
        round_for_capture(store, "", simulated=True)
    done = threading.Event()
    work = lambda _: done.wait(600)  # noqa: E731
    resources.worker().submit("Measuring the bundled captures", work, DEMONSTRATION)
    words = said(app("today", round=DEMONSTRATION))
    done.set()
    wait_for_jobs()
    assert "The example is being measured" in words
    assert "no stops yet" not in words
    assert "no stops yet" in said(app("today", round=DEMONSTRATION))


def test_an_old_round_says_nothing_of_today(house: Path) -> None:
    with open_store(house) as store:
        template = whole_stop(store, store.stops(WALK)[0].key)
        past = Round(name="past", started_s=1_700_000_000.0)
        store.save_round(past)
        stop = replace(template, key=new_key(), round_key=past.key, taken_s=past.started_s)
        store.save_stop(stop)
    test = app("today", round=past.key)
    assert "too old for today" in said(test)
    assert not test.metric


def test_a_clock_that_was_set_back_is_said(house: Path) -> None:
    with open_store(house) as store:
        template = whole_stop(store, store.stops(WALK)[0].key)
        ahead = Round(name="ahead")
        store.save_round(ahead)
        taken_s = ahead.started_s + 365 * 86_400
        store.save_stop(replace(template, key=new_key(), round_key=ahead.key, taken_s=taken_s))
    for page in ("today", "forecast"):
        words = said(app(page, round=ahead.key))
        assert "later than this computer's clock" in words
        assert "Measured yesterday" not in words


def test_today_counts_what_is_ready(house: Path) -> None:
    with open_store(house) as store:
        template = whole_stop(store, store.stops(WALK)[1].key)
        fresh = Round(name="today", house="house 9", profile="long-cucumber")
        store.save_round(fresh)
        store.save_stop(
            replace(template, key=new_key(), round_key=fresh.key, taken_s=fresh.started_s)
        )
        ready = [view for view in store.detections(fresh.key) if 0.25 < (view.length_m or 0) < 0.40]
    test = app("today", round=fresh.key)
    shown = {metric.label: metric.value for metric in test.metric}
    assert "Measured today" in said(test)
    assert int(shown["Ready today"]) + int(shown.get("Too long", 0)) >= len(ready) > 0
