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
from cucumbervision_greenhouse.pages.round_choice import label_options, of_round
from cucumbervision_greenhouse.round_view import RoundView, doubtful
from cucumbervision_greenhouse.rounds.forecasting import Age
from cucumbervision_greenhouse.rounds.walking import is_demonstration


@of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    today, rows = walk.today, walk.picks
    page_elements.draw_age(walk.round)
    if is_demonstration(walk.key):
        st.info(_("A computer-made example."), icon=":material/draw:")
    _next(walk, is_ready=bool(rows))
    if not rows or today is None:
        return
    _ready(walk, today)
    st.header(_("Pick list"))
    st.link_button(_("Print"), f"/api/print/{walk.key}", icon=":material/print:", width="stretch")
    _picks(walk, today, rows)


def _next(walk: RoundView, *, is_ready: bool) -> None:
    """Show what to do next, with a link to the page for it."""
    waiting = tasks.progress(walk.key).waiting
    if waiting:
        tasks.wake()
        words = counted(
            waiting,
            "{n} capture is still being measured.",
            "{n} captures are still being measured.",
        )
        page_elements.step(words, "capture", _("Capture"))
    if walk.age[1] is not Age.FRESH:
        page_elements.step(_("Start a new round and walk again."), "capture", _("Capture"))
    elif not is_ready and not waiting:
        words = _("No fruit is ready today. The forecast shows when.")
        page_elements.step(words, "forecast", _("Forecast"))
    if unsure := doubtful(walk.fruit):
        words = counted(
            len(unsure),
            "{n} fruit was seen only once, with low confidence. Please check.",
            "{n} fruit were seen only once, with low confidence. Please check.",
        )
        page_elements.step(words, "results", _("Show the least certain"), fruit=unsure[0].key)


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

    page_elements.metrics(numbers())
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


def _picks(walk: RoundView, today: Forecast, rows: dict[str, list[Pick]]) -> None:
    @st.fragment
    def _draw() -> None:
        picked = _picked(walk)
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
            persist_state="session",
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
        pick = resources.store().pick
        button(mark, words, "done_all", pick, unpicked, disabled=not unpicked)
        with undo:
            page_elements.draw_undo(walk.key)
        st.caption(_("Tap a fruit when it is picked. Tap again to undo."))


def _work(today: Forecast, picked: set[str]) -> None:
    rows = [ready_on(today, row=row, picked=picked) for row in today.rows]
    by_class = {name: sum(row.expected[name] for row in rows) for name in today.pick}
    hours, crates = work(by_class, [row.fruit for row in rows], resources.settings().rates)
    words = page_elements.work_words(hours, sum(crates.values()))
    says = _("About {work} at your rates ('Forecast', 'Work and crates'). It is {clock}.")
    st.caption(says.format(work=words, clock=f"{datetime.now():%H:%M}"))
