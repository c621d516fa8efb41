"""Parts that several pages draw."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard import resources
from cucumbervision.dashboard.jobs import Job, JobState
from cucumbervision.store.records import RoundRecord

if TYPE_CHECKING:
    from streamlit.delta_generator import DeltaGenerator

    from cucumbervision.store.views import DetectionView, RoundView

__all__ = ["CLASSES", "halves", "pick_round", "progress", "thumbnail_of"]

CLASSES = ("class I", "class II", "class III", "out of grade", "not graded")


def halves() -> tuple[DeltaGenerator, DeltaGenerator]:
    """Give a wide and a narrow column, under each other where a tablet is held upright."""
    with st.container(key="halves"):
        left, right = st.columns([3, 2], gap="medium")
    return left, right


def pick_round() -> RoundView | None:
    """Let a round be chosen, the newest first; None where there is none."""
    rounds = {one.key: one for one in resources.store().rounds()}
    if st.session_state.get("round") not in rounds:
        st.session_state["round"] = next(iter(rounds), None)
    chosen, new = st.columns([4, 1], vertical_alignment="bottom")
    with chosen:
        key = st.selectbox(
            "Round",
            list(rounds),
            format_func=lambda key: _round_name(rounds[key]),
            key="round",
            placeholder="No round yet: begin one",
        )
    with new, st.popover("New round", icon=":material/add:", width="stretch"):
        _new_round()
    return rounds.get(key) if key else None


def _round_name(one: RoundView) -> str:
    import time

    day = time.strftime("%Y-%m-%d %H:%M", time.localtime(one.record.started_s))
    house = f", {one.record.house}" if one.record.house else ""
    return f"{one.record.name or 'Round'}{house} · {day} · {one.stops} stops"


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


def progress(job: Job | None) -> None:
    """Show how far a job is, until it is done; then the page is drawn anew."""
    if job is None or job.finished.is_set():
        return

    @st.fragment(run_every=1.0)
    def _bar() -> None:
        if job.finished.is_set():
            st.rerun()
        words = f"{job.title}: {job.done} of {job.total}" if job.total else f"{job.title} …"
        waiting = " (waiting)" if job.state is JobState.WAITING else ""
        st.progress(job.share, text=words + waiting)

    _bar()


def thumbnail_of(view: DetectionView) -> str | None:
    """Give a fruit's little picture; None where none was kept."""
    if view.thumbnail is None:
        return None
    record = view.record
    box = (record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px)
    return resources.thumbnail(
        view.thumbnail.sha256, box, resources.capture_widths(view.stop_key)[view.capture]
    )
