"""Today: what is ready by class and row, how old that is, what to do next, and the pick list."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.agronomy.classes import class_name
from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.agronomy.picking import PickKind, work_of
from cucumbervision_greenhouse.backend import resources, round_caches, tasks
from cucumbervision_greenhouse.backend.round_tables import doubtful
from cucumbervision_greenhouse.backend.words import (
    counted,
    height_words,
    length_words,
    metres_words,
    pick_words,
    plain,
    round_day,
)
from cucumbervision_greenhouse.dashboard import page_elements
from cucumbervision_greenhouse.dashboard.callbacks import label_options
from cucumbervision_greenhouse.dashboard.page_elements import button
from cucumbervision_greenhouse.rounds.demonstration import is_demonstration
from cucumbervision_greenhouse.rounds.forecasting import Age, age_words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision_greenhouse.agronomy.picking import Pick
    from cucumbervision_greenhouse.rounds.forecasting import RowPicks, Today
    from cucumbervision_greenhouse.store.views import RoundSummary


@page_elements.of_round
def page(round_summary: RoundSummary) -> None:
    """Draw the page."""
    today = round_caches.today_of(round_summary)
    _age(round_summary, today)
    _next(round_summary, today)
    if not today.rows:
        return
    _ready(round_summary, today)
    st.subheader("Pick list")
    _picks(round_summary, today)


def _age(round_summary: RoundSummary, today: Today) -> None:
    walked = round_day(round_summary.walked_s)
    if not round_summary.stops:
        return
    if today.age is Age.USELESS:
        st.warning(
            f"This round is {age_words(today.age_days)} (walked on {walked}): it is "
            "too old for today. Walk the house again for today's list.",
            icon=":material/history:",
        )
        return
    ago = age_words(today.age_days).removeprefix("of ").replace(" old", " ago")
    words = f"**Measured {ago}** (last stop {walked})."
    if today.age_days:
        words += " Lengths include the growth expected since then."
    (st.warning if today.age is Age.OLD else st.markdown)(words)
    if is_demonstration(round_summary.key):
        st.info("A computer-made example.", icon=":material/draw:")


def _next(round_summary: RoundSummary, today: Today) -> None:
    """Show what to do next, with a link to the page for it."""
    progress = tasks.progress(round_summary.key)
    steps: list[tuple[str, str, str]] = []
    if progress.waiting:
        tasks.wake()
    if not round_summary.stops and progress.first_words:
        steps.append((progress.first_words, "capture", "Capture"))
    elif progress.waiting:
        words = counted(progress.waiting, "capture is", "captures are")
        steps.append((f"{words} still being measured.", "capture", "Capture"))
    if not round_summary.stops and is_demonstration(round_summary.key) and progress.title:
        st.info("The example is being measured; its fruit appear here.")
    elif not round_summary.stops and not progress.first_words:
        steps.append(("This round has no stops yet. Start walking a row.", "capture", "Capture"))
    elif round_summary.stops and today.age is not Age.FRESH:
        steps.append(("Start a new round and walk again.", "capture", "Capture"))
    elif round_summary.stops and not today.rows and not progress.waiting:
        steps.append(("No fruit is ready today. The forecast shows when.", "forecast", "Forecast"))
    if unsure := len(doubtful(round_caches.content_of(round_summary).views)):
        steps.append(
            (
                f"{counted(unsure, 'fruit was', 'fruit were')} seen only once, with low "
                "confidence. Please check.",
                "map",
                "Row map",
            )
        )
    for words, target, label in steps:
        says, go = st.columns([3, 1], vertical_alignment="center")
        says.markdown(f":material/arrow_forward: {words}")
        with go:
            page_elements.link(target, label)


def _ready(round_summary: RoundSummary, today: Today) -> None:
    """Say what is still to be picked, by class and row."""
    today = today.left(_picked(round_summary, today))
    ready, undecided, too_long = (len(today.of(kind)) for kind in PickKind)
    names = work_of(today.of(PickKind.READY)).by_class
    metrics = [("Ready today", ready), *((class_name(n), k) for n, k in sorted(names.items()))]
    other_kinds = [(PickKind.UNDECIDED, undecided), (PickKind.TOO_LONG, too_long)]
    labels = {name: class_name(name) for name in sorted(names)}
    for kind, count in other_kinds:
        if count:
            labels[str(kind)] = kind.capitalize()
            metrics.append((kind.capitalize(), count))
    with st.container(horizontal=True):
        for label, value in metrics:
            st.metric(plain(label), value, width="content")
    lines = []
    for row, counts_of_row in today.by_class().items():
        counts = {label: counts_of_row.get(name) or "" for name, label in labels.items()}
        lines.append({"Row": row or "not named", **counts, "All": sum(counts_of_row.values())})
    if len(lines) > 1:
        page_elements.table(lines)
    crop = resources.profile_of(round_summary)[1].title
    words = f"Classes of {crop}. {counted(ready, 'fruit is', 'fruit are')} left in the list below."
    if undecided:
        words += f" {undecided} more may be ready: their class is undecided."
    st.caption(plain(words))


_SAID = {
    PickKind.UNDECIDED: "**May be ready**: the length is not known well enough for one class",
    PickKind.TOO_LONG: "**Too long**: longer than every class; they slow the growth of others",
}


def _picks(round_summary: RoundSummary, today: Today) -> None:
    @st.fragment
    def _draw() -> None:
        picked = _picked(round_summary, today)
        rows = {row.row: row for row in today.rows}
        ready = {name: row_picks.of(PickKind.READY) for name, row_picks in rows.items()}
        done = {
            name: sum(_is_picked(p, picked) for p in row_picks) for name, row_picks in ready.items()
        }
        counts = {row: f"{plain(row or 'no row')}: {done[row]}/{len(ready[row])}" for row in rows}
        label = label_options("pick_row", counts)
        if st.session_state.get("pick_row") not in rows:
            named = st.query_params.get("row")
            page_elements.say_missing("row", rows, "Nothing is ready in row '{}' today.")
            st.session_state["pick_row"] = named if named in rows else next(iter(rows))
        name = st.segmented_control(
            "Row, in the order of the walk",
            list(rows),
            format_func=label,
            key="pick_row",
            required=True,
        )
        row = rows[name or next(iter(rows))]
        page_elements.name_in_address("row", row.row)
        total = f"{sum(done.values())} of {sum(map(len, ready.values()))} in all rows"
        for kind, words in zip(PickKind, (total, "look at them", "take them off"), strict=True):
            picks = row.of(kind)
            if not picks:
                continue
            if explanation := _SAID.get(kind):
                st.markdown(explanation)
            lines = _lines(round_summary, picks, picked, today.simulated)
            key = f"picks_{kind}_{round_summary.key}_{row.row}"
            page_elements.fruit_list(key, "Fruit to pick", lines, words, partial(_keep, key))
        _all_picked(row, picked)
        _work(today, picked)

    _draw()


def _is_picked(pick: Pick, picked: set[str]) -> bool:
    return pick.fruit.fruit_id in picked


def _picked(round_summary: RoundSummary, today: Today) -> set[str]:
    """Return the keys of the fruit that are picked by now."""
    keys = resources.store().picked(round_summary.key)
    return {today.best.get(key, key) for key in keys}


def _lines(
    round_summary: RoundSummary, picks: Sequence[Pick], picked: set[str], simulated: frozenset[str]
) -> list[dict[str, Any]]:
    units = resources.settings().units
    views = {view.key: view for view in round_caches.graded_round(round_summary).fruit}
    lines = []
    for pick in picks:
        key = pick.fruit.fruit_id
        view = views.get(key)
        says = [
            f"{metres_words(pick.fruit.position_m)} {pick.fruit.side}".strip(),
            "" if view is None else length_words(view.record, units),
            pick_words(pick),
            "" if view is None else height_words(view.record, units),
            "computer-made" if key in simulated else "",
        ]
        picture = None if view is None else round_caches.thumbnail_of(view)
        picked_now = _is_picked(pick, picked)
        lines.append({"key": key, "picture": picture, "says": says, "picked": picked_now})
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
            st.session_state.pop("picked_all", None)


def _all_picked(row: RowPicks, picked: set[str]) -> None:
    ready = row.of(PickKind.READY)
    unpicked = [p.fruit.fruit_id for p in ready if not _is_picked(p, picked)]

    @st.dialog("All picked?")
    def _ask() -> None:
        st.write(f"{len(unpicked)} fruit of row {plain(row.row)} will be marked as picked.")
        yes, no = st.columns(2)
        if yes.button("Yes, all are picked", type="primary", width="stretch"):
            st.session_state["picked_all"] = resources.store().pick(unpicked)
            st.rerun()
        if no.button("No", width="stretch"):
            st.rerun()

    with st.container(key="noprint"):
        mark, undo = st.columns(2)
        if mark.button(
            f"All of row {plain(row.row)} are picked",
            icon=":material/done_all:",
            width="stretch",
            disabled=not unpicked,
        ):
            _ask()
        number = st.session_state.get("picked_all")
        button(undo, "Undo 'all picked'", "undo", _undo, number, disabled=number is None)
        st.caption("Tap a fruit when it is picked. Tap again to undo.")


def _undo(number: int) -> None:
    try:
        resources.store().undo(number=number)
    except CucumberVisionError as error:
        st.toast(plain(error))
    st.session_state.pop("picked_all", None)


def _work(today: Today, picked: set[str]) -> None:
    if today.forecast is None:
        return
    clock = time.strftime("%H:%M")
    unpicked = today.left(picked).of(PickKind.READY)
    words = page_elements.work_words(work_of(unpicked, resources.settings().rates))
    st.caption(f"About {words} at your rates ('Forecast', 'Work and crates'). It is {clock}.")
