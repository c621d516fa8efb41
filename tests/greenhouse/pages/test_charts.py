from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

import pytest

pytest.importorskip("streamlit")

from cucumbervision_greenhouse.language import day_month_words
from cucumbervision_greenhouse.pages import charts
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import Store

COLORS = {
    "domain": ["class I", "class II", "no class", "undecided"],
    "range": ["#1B7837", "#5AAE61", "#E69F00", "#999999"],
}


def test_every_class_of_the_lines_has_its_colour() -> None:
    named = ("undecided", "class II", "no class", "class I", "class II")
    lines = [{"length": 20.0 + k, "class": name} for k, name in enumerate(named)]
    bars = charts.histogram(lines, Units("cm")).to_dict()["layer"][1]
    assert bars["encoding"]["color"]["scale"] == COLORS


def test_days_are_the_same_in_every_browser_wherever_it_is(
    in_zone: Callable[[str], None], store: Store
) -> None:
    in_zone("Pacific/Auckland")
    cm = Units("cm")
    views = store.detections(key_of("walk"))[:1]
    taken = datetime.fromtimestamp(views[0].taken_s)
    lines = [{"day": taken.date().isoformat(), "class": "class I", "fruit": 3}]
    for chart in (charts.trend_chart(lines), charts.growth_chart(views, cm)):
        (shown,) = (row["day"] for rows in chart.to_dict()["datasets"].values() for row in rows)
        assert shown == day_month_words(taken.date())
