"""Elements that several pages draw: the choice of a round, a job's progress, columns, tables."""

from __future__ import annotations

import math
import time
from functools import wraps
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.dashboard import resources
from cucumbervision.dashboard.plain_text import plain
from cucumbervision.rounds.walking import is_demonstration
from cucumbervision.store.records import RoundRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from streamlit.delta_generator import DeltaGenerator

    from cucumbervision.agronomy.picking import Rates
    from cucumbervision.dashboard.jobs import Job, Work
    from cucumbervision.store.views import RoundView

__all__ = [
    "button",
    "choose_page",
    "finished_job",
    "halves",
    "link",
    "of_round",
    "page_of",
    "progress",
    "start_job",
    "table",
    "work_words",
]


def halves() -> tuple[DeltaGenerator, DeltaGenerator]:
    """Return a wide and a narrow column, under each other where a tablet is held upright."""
    with st.container(key="halves"):
        left, right = st.columns([3, 2], gap="medium")
    return left, right


def button(
    place: Any, label: str, icon: str, act: Callable[..., object], *args: Any, **options: Any
) -> None:
    """Draw a button as wide as its place; pressing it calls `act` before the page is drawn anew."""
    icon = f":material/{icon}:"
    place.button(label, icon=icon, width="stretch", on_click=act, args=args, **options)


def table(lines: list[dict[str, Any]]) -> None:
    """Draw a table whose rows are high enough for a thumb."""
    st.dataframe(lines, hide_index=True, row_height=40)


def page_of(items: Sequence[Any], key: str, size: int) -> Sequence[Any]:
    """Return the items of the chosen page; `choose_page` with the same key lets it be chosen."""
    number = min(st.session_state.get(key, 1), _pages(items, size))
    return items[(number - 1) * size : number * size]


def choose_page(items: Sequence[Any], key: str, size: int) -> None:
    """Draw the choice of a page where there are several."""
    pages = _pages(items, size)
    if pages > 1:
        st.session_state[key] = min(st.session_state.get(key, 1), pages)
        st.number_input(f"Page of {pages}", 1, pages, key=key)


def _pages(items: Sequence[Any], size: int) -> int:
    return max(1, -(-len(items) // size))


def of_round(draw: Callable[[RoundView], None]) -> Callable[[], None]:
    """Make a page of a function that draws a round: the round is chosen above it."""

    @wraps(draw)
    def page() -> None:
        one = _pick_round()
        if one is None:
            st.info("There is no round yet: begin one with 'New round'.", icon=":material/flag:")
        else:
            draw(one)

    return page


def link(page: str, label: str) -> None:
    """Draw a way to another page, by the name that its address ends on."""
    found = st.session_state.get("pages", {}).get(page)
    if found is not None:
        st.page_link(found, label=label, icon=found.icon, width="stretch")


def work_words(fruit: int, rows: int, rates: Rates) -> str:
    """Return the work and crates that picking takes, for people.

    Examples
    --------
    >>> from cucumbervision.agronomy.picking import Rates
    >>> work_words(70, 1, Rates(350.0, 2.0, 12)), work_words(900, 4, Rates(350.0, 2.0, 12))
    ('14 minutes and 6 crates', '2.7 hours and 75 crates')
    """
    hours = fruit / rates.fruit_per_hour + rows * rates.minutes_per_row / 60
    time = f"{hours:.1f} hours" if hours >= 1.5 else f"{math.ceil(60 * hours - 1e-9)} minutes"
    crates = math.ceil(fruit / rates.fruit_per_crate)
    return f"{time} and {crates} {'crate' if crates == 1 else 'crates'}"


def _pick_round() -> RoundView | None:
    every = resources.store().rounds()
    # The grower's own first: the demonstration is no work of anybody's.
    every.sort(key=lambda one: is_demonstration(one.key))
    rounds = {one.key: one for one in every}
    if st.session_state.get("round") not in rounds:
        st.session_state["round"] = next(iter(rounds), None)
    chosen, new = st.columns([4, 1], vertical_alignment="bottom")
    key = chosen.selectbox(
        "Round",
        list(rounds),
        format_func=lambda key: _round_name(rounds[key]),
        key="round",
        placeholder="No round yet",
    )
    with new.popover("New round", icon=":material/add:", width="stretch"):
        _new_round()
    return rounds.get(key) if key else None


def _round_name(one: RoundView) -> str:
    day = time.strftime("%Y-%m-%d %H:%M", time.localtime(one.record.started_s))
    house = f", {one.record.house}" if one.record.house else ""
    stops = "1 stop" if one.stops == 1 else f"{one.stops} stops"
    return f"{one.record.name or 'Round'}{house} · {day} · {stops}"


def _new_round() -> None:
    name = st.text_input("Name", placeholder="Morning round", key="new_name")
    house = st.text_input("House", placeholder="House 1", key="new_house")

    def begin() -> None:
        record = RoundRecord(
            name=name.strip(), house=house.strip(), profile=resources.settings().profile
        )
        resources.store().save_round(record)
        st.session_state["round"] = record.key

    st.button("Begin this round", type="primary", width="stretch", on_click=begin)


def start_job(key: str, title: str, work: Work) -> None:
    """Queue a job and remember it in the viewer's session."""
    st.session_state[key] = resources.worker().submit(title, work).number


def finished_job(key: str) -> Job | None:
    """Return the viewer's job once it is finished; until then its progress is drawn."""
    job = resources.worker().get(st.session_state.get(key))
    progress(job)
    return job if job is not None and job.finished else None


def progress(job: Job | None) -> None:
    """Draw a job's progress until it is finished; then the page is drawn again."""
    if job is None or job.finished:
        return

    @st.fragment(run_every=1.0)
    def _bar() -> None:
        if job.finished:
            st.rerun()
        words = (
            f"{plain(job.title)}: {job.done} of {job.total}"
            if job.total
            else f"{plain(job.title)} …"
        )
        st.progress(job.share, text=words + (" (waiting)" if job.is_waiting else ""))

    _bar()
