"""Every figure of a round is the same on all pages, in all files and commands."""

from __future__ import annotations

import json
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("streamlit")

from streamlit.testing.v1 import AppTest
from tests.greenhouse.pages.app_pages import tables

from cucumbervision.crop.grades import class_name
from cucumbervision.crop.profiles import load_profile
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.exports.build import round_tables
from cucumbervision_greenhouse.forecast.picking import (
    PickKind,
    hours_words,
    pick_list,
    plan_work,
    work_of,
)
from cucumbervision_greenhouse.pages.accuracy import measured_round
from cucumbervision_greenhouse.round_view import grade_round, length_lines, map_lines
from cucumbervision_greenhouse.rounds.forecasting import forecast_today
from cucumbervision_greenhouse.rounds.from_store import find_round, read_round
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S, merge_round
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import Round, Verdict, key_of
from cucumbervision_greenhouse.store.repository import Store

WALK = key_of("walk")

pytestmark = pytest.mark.usefixtures("fresh_caches")


@pytest.fixture
def walked(store: Store) -> str:
    """A round of two days ago, every stop taken twice; of its fruit one is deleted, one picked,
    one seen only in part."""
    begun_s = time.time() - 2 * DAY_S
    one = Round(key_of("figures"), "figures", "house 1", begun_s, "long-cucumber")
    store.save_round(one)
    for n, stop in enumerate(store.stops(WALK)):
        for again in (0, 1):
            store.save_stop(
                replace(
                    store.stop(stop.key),
                    key=key_of("figures", n, again),
                    round_key=one.key,
                    row="1",
                    side="left",
                    position_m=5.0 * n + 0.01 * again,
                    step=2 * n + again,
                    taken_s=begun_s + 2 * n + again,
                )
            )
    merge_round(store, one.key)
    best = [view for view in store.detections(one.key) if view.best]
    assert max(view.views for view in best) > 1
    deleted, picked, hidden = best[0], best[1], best[2]
    page("results", one.key, fruit=deleted.key, press="Not a fruit")
    store.pick([picked.key])
    for view in store.detections(one.key):
        if view.group == hidden.group:
            seen = view.with_(flags="end-hidden", length=Length(0.26))
            store.correct(view.key, seen)
    return one.key


def page(
    name: str, round_key: str, *, fruit: str = "", press: str = "", **state: object
) -> AppTest:
    script = f"from cucumbervision_greenhouse.pages import {name}\n{name}.page()\n"
    test = AppTest.from_string(script, default_timeout=600)
    for key, value in {"round": round_key, **state}.items():
        test.session_state[key] = value
    if fruit:
        test.query_params["fruit"] = fruit
    test.run()
    if press:
        next(button for button in test.button if button.label == press).click().run()
    assert not test.exception
    return test


def table(test: AppTest) -> list[dict[str, str]]:
    """The lines of a page's last table, as it is drawn."""
    return tables(test)[-1]


def captions(test: AppTest) -> str:
    return " ".join(str(part.value) for part in (*test.markdown, *test.caption))


def test_every_fruit_and_class_is_counted_once_everywhere(store: Store, walked: str) -> None:
    profile, units = load_profile("long-cucumber"), Units("cm")
    files = round_tables(store, walked, profile)
    lines: list[dict[str, Any]] = files["fruit"].rows
    graded = grade_round(read_round(store, walked), fruit_table(read_round(store, walked)), profile)

    # The list of the results: each fruit of the files, with its length and class.
    results = page("results", walked)
    [drawn] = [x for x in results.get("bidi_component") if "fruitlist" in x.proto.component_name]
    listed = json.loads(drawn.proto.json)["fruit"]
    assert f"{len(lines)} fruit" in json.loads(drawn.proto.json)["words"]
    lengths = Counter(one["says"][0].split(" (")[0].removeprefix("at least ") for one in listed)
    assert lengths == Counter(units.text(line["length_cm"] / 100) for line in lines)
    words = Counter(one["says"][1] for one in listed)
    assert words == Counter(line["grade_words"] for line in lines)
    hangs = [line for line in lines if line["picked_utc"] is None]
    classes = Counter(class_name(line["grade"]) for line in hangs)
    assert classes["too short"] > 0
    said = ", ".join(f"{number} {name}" for name, number in sorted(classes.items()))
    assert f"**{said}**" in captions(results)

    # The map: the same fruit, the picked one crossed.
    marks = map_lines(graded, units)
    assert Counter(units.text(x["length"] / 100) for x in marks) == lengths
    assert [x["mark"] for x in marks].count("picked") == files.summary["picked"] == 1
    picked = next(x for x in marks if x["mark"] == "picked")
    assert "picked" in next(x for x in listed if x["key"] == picked["key"])["says"][3]
    [row] = files["rows"].rows
    assert row["fruit"] == len(lines)

    # Work and crates of the days, and of today.
    work: list[dict[str, Any]] = files["work"].rows
    shown = table(page("forecast", walked, forecast_tabs="Work and crates"))
    days = [line for line in work if line["fruit_high"] >= 1]
    assert len(shown) == len(days) > 1
    for line, day in zip(shown, days, strict=True):
        assert line["Fruit"].split(" ")[0] == f"{day['fruit']:.0f}"
        if day["fruit"] >= 1:  # of less than a minute a file keeps too few digits
            assert line["Work"].split(" (")[0] == hours_words(day["hours"])
    today = captions(page("today", walked))
    crates = f"{work[0]['crates']:.0f} crate"
    assert f"About {hours_words(work[0]['hours'])} and {crates}" in today
    assert work[0]["fruit"] == 1
    assert "1 fruit is left in the list" in today


def test_every_figure_is_one_number_everywhere(store: Store, walked: str) -> None:
    profile, units = load_profile("long-cucumber"), Units("cm")
    one, content = find_round(store, walked), read_round(store, walked)
    table = fruit_table(content)
    graded = grade_round(content, table, profile)
    files = round_tables(store, walked, profile)
    gone = {view.key for view in content.views if view.verdict is Verdict.REJECTED}

    # Numbers of fruit and their lengths.
    shown = {metric.label: str(metric.value) for metric in page("results", walked).metric}
    summary = files.summary
    assert shown["Fruit"] == str(summary["fruit"]) == str(len(files["fruit"].rows))
    assert shown["Measured"] == str(summary["measured"])
    assert (shown["Picked"], summary["picked"]) == ("1", 1)
    assert shown["Deleted"] == "1"
    assert summary["detections"] == len(content.views) - len(gone)
    charted = [line["length"] for line in length_lines(graded.fruit, graded.grades, units)]
    hanging = [
        float(str(line["length_cm"]))
        for line in files["fruit"].rows
        if line["picked_utc"] is None and "at least" not in str(line["remarks"])
    ]
    assert len(hanging) == len(graded.fruit) - 2  # without the picked one and the lower bound
    assert sorted(charted) == pytest.approx(sorted(hanging), abs=1e-3)
    assert np.mean(charted) == pytest.approx(summary["mean_length_cm"], abs=0.01)
    assert shown["Mean length"] == units.text(float(np.mean(charted)) / 100)

    # No deleted fruit on the map, in the list or on the accuracy page.
    assert gone.isdisjoint(line["key"] for line in map_lines(graded, units))
    assert gone.isdisjoint(view.key for view in graded.fruit)
    measured = measured_round(store, walked)
    assert len(measured.readings) == len(content.views) - len(gone)
    reported = {(x.capture, x.fruit): x.lengths_m["reported"] for x in measured.readings}
    for view in graded.fruit:
        at = f"{view.stop_key}/{view.capture}", view.fruit
        assert reported[at] == view.length_m

    # What is ready, and its work.
    forecast = forecast_today(store, one, profile, time.time(), content)
    picks = [pick for pick in pick_list(forecast) if pick.kind is PickKind.READY]
    work, plan = work_of(picks), plan_work(forecast)[0]
    today = page("today", walked)
    assert len(picks) == work.fruit == plan.fruit.expected == summary["ready_today"]
    assert {metric.label: str(metric.value) for metric in today.metric}["Ready today"] == str(
        len(picks)
    )
    first = files["work"].rows[0]
    assert (first["fruit"], first["crates"]) == (work.fruit, sum(work.crates.values()))
    assert first["hours"] == pytest.approx(work.hours, abs=1e-3)
    said = " ".join(str(part.value) for part in today.caption)
    assert f"About {hours_words(work.hours)} and " in said
    table_of_work = " ".join(str(part.value) for part in page("forecast", walked).markdown)
    assert hours_words(work.hours) == hours_words(plan.hours.expected)
    assert "-0" not in table_of_work
    assert all(str(span.low) != "-0.0" for span in plan.crates.values())
