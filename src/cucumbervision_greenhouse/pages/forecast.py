"""Forecast: how many fruit will be in which class, and the work that picking them takes."""

from __future__ import annotations

from datetime import date, timedelta
from functools import partial
from typing import Any

import streamlit as st

from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.forecast.picking import Span, plan_work, ready_on
from cucumbervision_greenhouse.language import day_month_words, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.round_choice import of_round
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.harvest import (
    HEAD,
    HarvestLine,
    fruit_kg,
    keep_harvest,
    read_harvest,
)

_FIELD_PX = 170  # two side by side on a phone
_DAYS_BACK = 31  # days whose harvest can be entered in fields


@of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    prediction = walk.forecast
    if not prediction.fruit:
        st.info(
            _("Nothing to forecast: this round has no measured fruit left on the plant."),
            icon=":material/calendar_month:",
        )
        _harvest(walk)
        return
    page_elements.draw_age(walk.round)
    page_elements.link("today", _("Today's pick list"))
    names = [_("Next days"), _("Work and crates"), _("Harvest")]
    days, work, harvest = st.tabs(names, key="forecast_tabs", on_change="rerun")
    with days:
        _days(prediction)
    for part, draw in ((work, _work), (harvest, _harvest)):
        if part.open:
            with part:
                draw(walk)


def _days(prediction: Forecast) -> None:
    first = [
        f"{texts.class_words(name)} {texts.forecast_day(prediction, day)}"
        for name, day in texts.first_days(prediction).items()
    ]
    if first:
        st.markdown(_("**First fruit ready**: {days}").format(days=plain(", ".join(first))))
    st.markdown(_("**Fruit in each class if nothing is picked**, with the likely range"))
    from cucumbervision_greenhouse.pages import charts

    st.altair_chart(charts.forecast_chart(prediction))
    house = prediction.house
    lines = []
    for day in prediction.days.tolist():
        ready = ready_on(prediction, day)
        line: dict[str, object] = {
            _("Day"): texts.forecast_day(prediction, day),
            _("Ready"): f"{texts.count_words(ready.fruit)} ({ready.sure} + {ready.may_be})",
        }
        for k in texts.expected_classes(prediction):
            count = Span(house.expected[day, k], house.low[day, k], house.high[day, k])
            words = texts.span_words(count)
            if words != "–" and not prediction.complete[day, k]:
                words = _("{fruit} or more").format(fruit=words)
            line[texts.class_words(prediction.classes[k])] = words
        lines.append(line)
    page_elements.table(lines)
    st.caption(
        _(
            "Ready is the expected number: the sum of what is likely of each fruit; in brackets, "
            "those surely ready + those that may be. 'Or more': fruit too small to be detected "
            "today are not counted."
        )
    )
    with st.expander(_("Details"), icon=":material/list:"):
        growth = texts.growth_words(prediction.growth, resources.settings().units)
        st.caption(f"{_('Ranges are 80 % intervals.')} {plain(growth)}")


def _work(walk: RoundView) -> None:
    saved, prediction = resources.settings(), walk.forecast
    kg = fruit_kg(walk.harvests, walk.fruit, walk.profile)
    per_hour, per_row, per_crate = st.columns(3)
    for name, column, label, low, high, step in (
        ("fruit_per_hour", per_hour, _("Fruit picked in an hour"), 1.0, 5000.0, 10.0),
        ("minutes_per_row", per_row, _("Minutes for each row"), 0.0, 120.0, 0.5),
        ("fruit_per_crate", per_crate, _("Fruit in a crate"), 1, 500, 1),
    ):
        limits = page_elements.spanning(low, high, getattr(saved, name))[:2]
        page_elements.setting(name, column.number_input, label, *limits, step=step)
    lines = [
        {
            _("Day"): texts.forecast_day(prediction, day.day),
            _("Fruit"): texts.span_words(day.fruit),
            _("kg"): "–" if kg is None else texts.count_words(kg * day.fruit.expected),
            _("Work"): texts.hours_span_words(day.hours),
            **{
                _("Crates {name}").format(name=name): texts.span_words(n)
                for name, n in day.crates.items()
            },
        }
        for day in plan_work(prediction, resources.settings().rates)
        if texts.count_words(day.fruit.expected) != "0"
    ]
    page_elements.table(lines)
    st.caption(_("If every ready fruit is picked every day. Hours for one person."))


def _harvest(walk: RoundView) -> None:
    """Draw forecasts beside what was picked, what is kept of it, and a field for more."""
    kg = fruit_kg(walk.harvests, walk.fruit, walk.profile)
    page_elements.table(
        [
            {
                _("Days"): str(line.days),
                _("Rounds"): str(line.rounds),
                _("Forecast"): _with_kg(line.forecast, kg and kg * line.forecast),
                _("Harvest"): _with_kg(line.harvest, kg and kg * line.harvest),
                _("Error"): f"{100 * line.error:.0f} %",
                _("In the range"): f"{100 * line.within:.0f} %",
            }
            for line in walk.compared
        ]
    )
    st.caption(
        _(
            "What the newest rounds of this house forecast to be picked from the day of the walk "
            "on, and what was picked: as entered below, or else ticked on the pick list. The range "
            "should hold 80 % of the harvests."
        )
    )
    newest = sorted(walk.harvests.items(), reverse=True)[:7]
    page_elements.table(
        [
            {_("Day"): day_month_words(day), _("Harvest"): _with_kg(*of_day)}
            for day, of_day in newest
        ]
    )
    st.markdown(f"**{_('Picked fruit')}**")
    number = st.session_state.setdefault("harvests", 0)
    rows = dict.fromkeys(["", *(stop.row or "" for stop in walk.content.stops)])
    days = [date.today() - timedelta(age) for age in range(_DAYS_BACK)]
    names = {day: texts.date_words(day, days[0]) for day in days}
    with st.container(horizontal=True):
        select = partial(page_elements.choose, st.selectbox, width=_FIELD_PX)
        select(_("Day"), names, key="harvest_day")
        select(_("Row"), {row: row or _("whole house") for row in rows}, key="harvest_row")
    for name in walk.profile.pick:
        with st.container(horizontal=True):
            fruit = _("{name}: fruit").format(name=plain(texts.class_words(name)))
            keys = [f"harvest_{what}_{name}_{number}" for what in ("fruit", "kg")]
            st.number_input(fruit, 0, value=None, key=keys[0], width=_FIELD_PX)
            st.number_input(_("kg"), 0.0, value=None, key=keys[1], width=_FIELD_PX)
    file = page_elements.section(_("From a CSV file"), "upload_file", "csv")
    if file is not None:
        words = _(
            "A line a day, row and class, below the names {names}; fruit or crates are needed."
        )
        how: dict[str, Any] = {"max_upload_size": 1, "key": f"harvest_file_{number}"}
        file.file_uploader(words.format(names=HEAD), "csv", **how)
    page_elements.button(st, _("Keep this harvest"), "save", _keep, walk, number)
    page_elements.draw_undo(walk.key)


def _keep(walk: RoundView, number: int) -> None:
    """Keep what the fields hold, and the lines of the file; then there are new fields."""
    fields, lines, unknown = st.session_state, list[HarvestLine](), list[str]()
    if (file := fields.get(f"harvest_file_{number}")) is not None:
        text = file.getvalue().decode("utf-8-sig", "replace")
        lines, unknown = read_harvest(text, resources.settings().fruit_per_crate)
    for name in walk.profile.pick:
        fruit, kg = (fields[f"harvest_{what}_{name}_{number}"] for what in ("fruit", "kg"))
        if fruit is not None:
            day, row = fields["harvest_day"], fields["harvest_row"]
            line = {"day": day, "row": row, "class": name, "fruit": fruit, "kg": kg}
            lines.append(HarvestLine.model_validate(line))
    keep_harvest(resources.store(), walk.key, lines, date.today())
    fields["harvests"] += 1
    if unknown:
        words = _("Columns that are not used: {names}").format(names=", ".join(unknown))
        st.toast(plain(words), icon=":material/info:")


def _with_kg(fruit: float, kg: float | None) -> str:
    words = texts.count_words(fruit)
    return words if kg is None else f"{words} ({texts.count_words(kg)} kg)"
