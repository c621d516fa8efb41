"""Today: what is ready by class and row, how old that is, what to do next, and the pick list."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from functools import partial
from typing import Any

import streamlit as st

from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.forecast.picking import Pick, PickKind, ready_on, work
from cucumbervision_greenhouse.language import counted, marked, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.page_elements import button
from cucumbervision_greenhouse.pages.round_choice import label_options
from cucumbervision_greenhouse.round_view import RoundView, doubtful
from cucumbervision_greenhouse.rounds.forecasting import Age, Today
from cucumbervision_greenhouse.rounds.walking import is_demonstration
from cucumbervision_greenhouse.store.records import Round


@page_elements.of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    round_summary = walk.round
    today = round_view.today_of(round_summary)
    _age(round_summary, today)
    _next(walk, today)
    if not today.rows or today.forecast is None:
        return
    _ready(walk, today.forecast)
    st.header(_("Pick list"))
    address = f"/api/print/{round_summary.key}"
    st.link_button(_("Print"), address, icon=":material/print:", width="stretch")
    _picks(walk, today)


def _age(round_summary: Round, today: Today) -> None:
    if not round_summary.stops:
        return
    days, walked = today.age_days, texts.round_day(round_summary.walked_s)
    if days < 0:
        st.warning(texts.clock_words(round_summary.walked_s), icon=":material/error:")
        return
    if today.age is Age.USELESS:
        words = _(
            "This round is {age} (walked on {when}): it is too old for today. Walk the house again "
            "for today's list."
        )
        words = words.format(age=texts.age_words(days), when=walked)
        st.warning(words, icon=":material/history:")
        return
    words = _("**Measured today** (last stop {when}).")
    if days:
        words = _("**Measured yesterday** (last stop {when}).")
    if days > 1:
        words = counted(
            days,
            "**Measured {n} day ago** (last stop {when}).",
            "**Measured {n} days ago** (last stop {when}).",
            when=walked,
        )
    (st.warning if today.age is Age.OLD else st.markdown)(words.format(when=walked))
    if is_demonstration(round_summary.key):
        st.info(_("A computer-made example."), icon=":material/draw:")


def _next(walk: RoundView, today: Today) -> None:
    """Show what to do next, with a link to the page for it."""
    round_summary = walk.round
    progress = tasks.progress(round_summary.key)
    steps: list[tuple[str, str, str]] = []
    if progress.waiting:
        tasks.wake()
    if not round_summary.stops and progress.first:
        steps.append((progress.first, "capture", _("Capture")))
    elif progress.waiting:
        words = counted(
            progress.waiting,
            "{n} capture is still being measured.",
            "{n} captures are still being measured.",
        )
        steps.append((words, "capture", _("Capture")))
    if not round_summary.stops and is_demonstration(round_summary.key) and progress.words:
        st.info(_("The example is being measured; its fruit appear here."))
    elif not round_summary.stops and not progress.first:
        page_elements.first_steps(begun=True)
    elif round_summary.stops and today.age is not Age.FRESH:
        steps.append((_("Start a new round and walk again."), "capture", _("Capture")))
    elif round_summary.stops and not today.rows and not progress.waiting:
        words = _("No fruit is ready today. The forecast shows when.")
        steps.append((words, "forecast", _("Forecast")))
    if unsure := len(doubtful(walk.content.views)):
        words = counted(
            unsure,
            "{n} fruit was seen only once, with low confidence. Please check.",
            "{n} fruit were seen only once, with low confidence. Please check.",
        )
        steps.append((words, "map", _("Row map")))
    for words, target, label in steps:
        says, go = st.columns([3, 1], vertical_alignment="center")
        says.markdown(f":material/arrow_forward: {words}")
        with go:
            page_elements.link(target, label)


def _ready(walk: RoundView, forecast: Forecast) -> None:
    """Say what is still to be picked, by class and row."""
    picked = _picked(walk)

    def numbers(row: str | None = None) -> dict[str, str | int]:
        ready = ready_on(forecast, row=row, picked=picked)
        classes = ready.expected if len(ready.expected) > 1 else {}
        return {
            _("Ready today"): texts.count_words(ready.fruit),
            **{texts.class_words(k): texts.count_words(number) for k, number in classes.items()},
            _("Sure"): ready.sure,
            _("May be ready"): ready.may_be,
            _("Too long"): ready.too_long,
        }

    with st.container(horizontal=True):
        for label, value in numbers().items():
            st.metric(plain(label), value, width="content")
    if len(rows := forecast.rows) > 1:
        page_elements.table([{_("Row"): row or _("not named"), **numbers(row)} for row in rows])
    words = _(
        "Classes of {crop}. Ready is the expected number: the sum of what is likely of each fruit."
    )
    st.caption(plain(words.format(crop=_(walk.profile.title))))


_SAID = {
    PickKind.UNDECIDED: marked(
        "**May be ready**: the length is not known well enough for one class"
    ),
    PickKind.TOO_LONG: marked(
        "**Too long**: longer than every class; they slow the growth of others"
    ),
}


def _picks(walk: RoundView, today: Today) -> None:
    @st.fragment
    def _draw() -> None:
        picked = _picked(walk)
        rows = today.rows
        ready = {row: [p for p in rows[row] if p.kind is PickKind.READY] for row in rows}
        done = {row: sum(_is_picked(p, picked) for p in ready[row]) for row in rows}
        counts = {
            row: f"{plain(row or _('no row'))}: {done[row]}/{len(ready[row])}" for row in rows
        }
        label = label_options("pick_row", counts)
        if st.session_state.get("pick_row") not in rows:
            named = st.query_params.get("row")
            page_elements.say_missing("row", rows, _("Nothing is ready in row '{}' today."))
            st.session_state["pick_row"] = named if named in rows else next(iter(rows))
        name = st.segmented_control(
            _("Row, in the order of the walk"),
            list(rows),
            format_func=label,
            key="pick_row",
            required=True,
        )
        row = next(iter(rows)) if name is None else name
        page_elements.name_in_address("row", row)
        page_elements.rows(walk, [row])
        total = _("{done} of {all} in all rows").format(
            done=sum(done.values()), all=sum(map(len, ready.values()))
        )
        says = (total, _("look at them"), _("take them off"))
        for kind, words in zip(PickKind, says, strict=True):
            picks = [pick for pick in rows[row] if pick.kind is kind]
            if not picks:
                continue
            if explanation := _SAID.get(kind):
                st.markdown(_(explanation))
            lines = _lines(walk, picks, picked)
            key = f"picks_{kind}_{walk.key}_{row}"
            page_elements.fruit_list(key, _("Fruit to pick"), lines, words, partial(_keep, key))
        _all_picked(walk, row, [p.fruit.fruit_id for p in ready[row] if not _is_picked(p, picked)])
        _work(today, picked)

    _draw()


def _is_picked(pick: Pick, picked: set[str]) -> bool:
    return pick.fruit.fruit_id in picked


def _picked(walk: RoundView) -> set[str]:
    """Return the keys of the fruit that are picked by now."""
    groups = walk.content.group_of
    return {groups.get(key, key) for key in resources.store().picked(walk.key)}


def _lines(walk: RoundView, picks: Sequence[Pick], picked: set[str]) -> list[dict[str, Any]]:
    units = resources.settings().units
    views = {view.key: view for view in walk.fruit}
    lines = []
    for pick in picks:
        if (view := views.get(pick.fruit.fruit_id)) is None:  # deleted since
            continue
        says = [
            f"{texts.position_words(view.along_m, units)} {texts.side_words(view.side)}".strip(),
            texts.today_words(view, walk.today_m.get(view.key), units),
            texts.pick_words(pick),
            texts.height_words(view),
            _("computer-made") if view.simulated else "",
        ]
        picture, is_picked = round_view.thumbnail_of(view), _is_picked(pick, picked)
        lines.append({"key": view.key, "picture": picture, "says": says, "picked": is_picked})
    return lines


def _keep(key: str) -> None:
    """Save new taps; each message also contains the earlier ones."""
    handled: set[str] = st.session_state.setdefault("taps_seen", set())
    store = resources.store()
    for tap in st.session_state[key].taps or ():
        if tap["number"] not in handled:
            handled.add(tap["number"])
            fruit = [str(tap["key"])]
            store.pick(fruit) if tap["picked"] else store.unpick(fruit)


def _all_picked(walk: RoundView, row: str, unpicked: list[str]) -> None:
    with st.container(key="noprint"):
        mark, undo = st.columns(2)
        words = _("All of row {row} are picked").format(row=plain(row))
        mark_all = partial(page_elements.do, partial(resources.store().pick, unpicked))
        button(mark, words, "done_all", mark_all, disabled=not unpicked)
        with undo:
            page_elements.draw_undo(walk.key)
        st.caption(_("Tap a fruit when it is picked. Tap again to undo."))


def _work(today: Today, picked: set[str]) -> None:
    if today.forecast is None:
        return
    rows = [ready_on(today.forecast, row=row, picked=picked) for row in today.forecast.rows]
    by_class = {name: sum(row.expected[name] for row in rows) for name in today.forecast.pick}
    hours, crates = work(by_class, [row.fruit for row in rows], resources.settings().rates)
    words = page_elements.work_words(hours, sum(crates.values()))
    says = _("About {work} at your rates ('Forecast', 'Work and crates'). It is {clock}.")
    st.caption(says.format(work=words, clock=f"{datetime.now():%H:%M}"))
