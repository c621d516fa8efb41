from __future__ import annotations

import re
import time
from datetime import date
from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from streamlit.testing.v1 import AppTest
from tests.greenhouse.pages.app_pages import app, field, said, tables

from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_the_forecast_names_days_by_their_dates(house: Path) -> None:
    test = app("forecast")
    days = [line["Day"] for line in tables(test)[0]]
    in_two_days = time.localtime(time.time() + 2 * 86400)
    assert days[:3] == ["today", "tomorrow", time.strftime("%a %-d %b", in_two_days)]
    # Some of the eight bundled fruit are class I as they were measured.
    assert "class I today" in said(test)


def test_work_is_drawn_where_it_is_open(house: Path) -> None:
    test = app("forecast")
    assert not test.number_input
    test.session_state["forecast_tabs"] = "Work and crates"
    assert len(test.run().number_input) == 3


def test_growth_is_told_in_the_unit_of_the_lengths(house: Path) -> None:
    assert "Expected growth: 3.0 cm a day (2.0 to 4.0)" in said(app("forecast"))
    resources.change_settings(
        unit="in"
    )  # 3 cm are 1.181 in, 2 and 4 cm (one digit) 0.79 and 1.57 in
    assert re.search(
        r"Expected growth: 1\.18 in a day \(0\.[78]\d to 1\.5\d\)", said(app("forecast"))
    )


def test_rates_beyond_the_limits_of_their_fields_are_shown(house: Path) -> None:
    rates = {"fruit_per_hour": 9000.0, "minutes_per_row": 500.0, "fruit_per_crate": 2000}
    resources.change_settings(**rates)
    assert not app("forecast", forecast_tabs="Work and crates").exception
    assert {name: getattr(resources.settings(), name) for name in rates} == rates


def _kept(test: AppTest, text: str = "") -> AppTest:
    if text:
        test.file_uploader[0].set_value(("harvest.csv", text.encode(), "text/csv"))
    [button] = [x for x in test.button if x.label == "Keep this harvest"]
    return button.click().run()


def test_a_harvest_is_kept_beside_what_was_forecast_and_a_wrong_one_changes_nothing(
    house: Path,
) -> None:
    with open_store(house) as store:
        day = date.fromtimestamp(store.rounds()[0].walked_s)
        test = app("forecast", forecast_tabs="Harvest", csv=True)
        assert "No picked fruit were entered" in said(_kept(test))
        for text, fault in (
            (f"day;fruit\n{day.replace(year=day.year - 1)};2", "is not between the first round"),
            (f"day;fruit\n{day};200", "200 fruit were picked on"),
        ):
            assert fault in said(_kept(test, text))
            assert store.log(kind="harvest") == []
        test = _kept(test, f"day;fruit;kg\n{day};2;0,9")
        assert tables(test)[-1][0]["Harvest"] == "2 (0.9 kg)"
        test.selectbox(key="harvest_day").set_value(day)
        field(test, "number_input", "class I: fruit").set_value(3)
        field(test, "number_input", "kg").set_value(1.2)
        test = _kept(test.run())
        assert tables(test)[-1][0]["Harvest"] == "5 (2.1 kg)"
        assert field(test, "number_input", "class I: fruit").value is None
