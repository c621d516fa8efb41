"""Forecast: how many fruit will be in which class, and the work that picking them takes."""

from __future__ import annotations

import time
from datetime import date
from functools import partial

import streamlit as st

from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.forecast.picking import Span, plan_work, ready_on
from cucumbervision_greenhouse.language import day_month_words, language, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.resources import KEPT
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.forecasting import Age, age_of
from cucumbervision_greenhouse.rounds.harvest import HEAD, fruit_kg, keep_harvest, read_harvest
from cucumbervision_greenhouse.store.records import Round


@page_elements.of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    prediction = walk.forecast
    if not prediction.fruit:
        st.info(
            _("Nothing to forecast: this round has no measured fruit left on the plant."),
            icon=":material/calendar_month:",
        )
        return
    _age(walk.round)
    names = [_("Next days"), _("Work and crates"), _("Harvest")]
    days, work, harvest = st.tabs(names, key="forecast_tabs", on_change="rerun")
    with days:
        _days(prediction)
    for part, draw in ((work, _work), (harvest, _harvest)):
        if part.open:
            with part:
                draw(walk)


def _age(round_summary: Round) -> None:
    walked = round_summary.walked_s
    days, age = age_of(walked, time.time())
    if days < 0:
        st.warning(texts.clock_words(walked), icon=":material/error:")
    if age is not Age.FRESH:
        words = _(
            "This round is {age} (walked on {when}): the forecast is valid only if nothing was "
            "picked since. Walk again."
        )
        if age is Age.USELESS:
            words = _(
                "This round is {age} (walked on {when}): the forecast is valid for the day of the "
                "walk. Walk again."
            )
        st.warning(
            words.format(age=texts.age_words(days), when=texts.round_day(walked)),
            icon=":material/history:",
        )
    page_elements.link("today", _("Today's pick list"))


def _drawn(prediction: Forecast) -> tuple[object, ...]:
    """Return all that the chart of a forecast shows."""
    house = prediction.house
    numbers = (x.tobytes() for x in (house.expected, house.low, house.high))
    return (prediction.today, date.today(), prediction.classes, *numbers)


@st.cache_resource(show_spinner=False, max_entries=KEPT, ttl=600, hash_funcs={Forecast: _drawn})
def _chart(prediction: Forecast, language: str, theme: str | None) -> None:  # noqa: ARG001, as it is shown
    """Draw the chart; Altair makes it once, since that takes as long as the rest of the page."""
    from cucumbervision_greenhouse.pages import charts

    st.altair_chart(charts.forecast_chart(prediction))


def _days(prediction: Forecast) -> None:
    first = [
        f"{texts.class_words(name)} {texts.forecast_day(prediction, day)}"
        for name, day in texts.first_days(prediction).items()
    ]
    if first:
        st.markdown(_("**First fruit ready**: {days}").format(days=plain(", ".join(first))))
    st.markdown(_("**Fruit in each class if nothing is picked**, with the likely range"))
    _chart(prediction, language(), st.context.theme.type)
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
    first = f"{HEAD}\n{date.today()};;;;;"
    help_ = _("A line a day, row and class; or paste a table. Fruit or crates are needed.")
    st.text_area(_("Picked fruit"), first, key="harvest", help=help_)
    keep = partial(page_elements.do, partial(_keep, walk.key))
    page_elements.button(st, _("Keep this harvest"), "save", keep)
    page_elements.draw_undo(walk.key)


def _keep(round_key: str) -> None:
    text = str(st.session_state["harvest"])
    lines, unknown = read_harvest(text, resources.settings().fruit_per_crate)
    keep_harvest(resources.store(), round_key, lines, date.today())
    if unknown:
        words = _("Columns that are not used: {names}").format(names=", ".join(unknown))
        st.toast(plain(words), icon=":material/info:")


def _with_kg(fruit: float, kg: float | None) -> str:
    words = texts.count_words(fruit)
    return words if kg is None else f"{words} ({texts.count_words(kg)} kg)"
