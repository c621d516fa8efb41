"""Results: the statistics of a round, its fruit in a table, its files, and each fruit by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any
from urllib.parse import urlencode

import streamlit as st

from cucumbervision_greenhouse import resources, round_view
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.language import counted, marked, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import fruit as fruit_page
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.round_choice import label_options, of_round
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.fruit_table import (
    hanging_lengths_m,
    on_the_plant,
    round_figures,
)
from cucumbervision_greenhouse.rounds.walking import is_demonstration
from cucumbervision_greenhouse.store.records import FruitRow, Verdict

_FORMATS = {
    ExportFormat.XLSX: marked("Excel"),
    ExportFormat.CSV: "CSV",
    ExportFormat.HTML: marked("Page to print"),
    ExportFormat.PARQUET: marked("Parquet"),
    ExportFormat.JSON: "JSON",
}


def _files(round_key: str) -> None:
    """Draw the choice of formats, and the link that makes and loads the files."""
    names = {name: _(words) for name, words in _FORMATS.items()}
    usual = [ExportFormat.XLSX, ExportFormat.CSV, ExportFormat.HTML]
    how: dict[str, Any] = {"selection_mode": "multi", "default": usual, "key": "formats"}
    formats = page_elements.choose(st.pills, _("Formats"), names, **how)
    if formats:
        asked = urlencode([("formats", str(chosen)) for chosen in formats])
        st.html(
            f'<a class="load" href="/api/files/{round_key}?{asked}" download>{_("Download")}</a>'
        )


_VERDICTS = {
    None: "",
    Verdict.ACCEPTED: marked("✓ accepted"),
    Verdict.REJECTED: marked("✗ not a fruit"),
}


@of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    groups = walk.content.group_of
    opened = groups.get(st.query_params.get("fruit", ""), "")  # by any of its views
    if opened in walk.grades:
        fruit = _listed(walk)
        with st.container(key="panes"):  # on a wide screen the list is beside its fruit
            list_side, fruit_side = st.columns([1, 3], gap="medium")
        with fruit_side:
            fruit_page.show(walk, opened, fruit)
        if "mobi" not in st.context.headers.get("user-agent", "mobi").lower():
            with list_side:
                _list(walk, fruit, opened)
        return
    page_elements.say_missing(
        "fruit", groups, _("There is no such fruit in this round (any more).")
    )
    if not walk.best:
        st.info(_("No fruit was found at the stops of this round."), icon=":material/search_off:")
        return
    _classes(walk)
    _statistics(walk)
    _filters(walk)
    fruit = _listed(walk)
    if not fruit:
        st.info(_("No fruit matches these filters."), icon=":material/filter_alt_off:")
        return
    _list(walk, fruit)
    _chart(walk, fruit)
    files = page_elements.section(_("Files of this round"), "download", "files")
    if files is not None:
        with files:
            _files(walk.key)


def _classes(walk: RoundView) -> None:
    """Say first what a grower asks first: how many of each class, and where the list is."""
    counts = walk.counts(on_the_plant(walk.fruit))
    words = ", ".join(
        f"{number} {texts.label_words(name)}" for name, number in sorted(counts.items())
    )
    words = f"**{plain(words or _('No fruit on the plant'))}**"
    page_elements.step(words, "today", _("What is ready today"))
    if (ready := walk.ready) is not None:
        st.caption(texts.ready_words(ready))
    if is_demonstration(walk.key):
        st.caption(_("A computer-made example."))


def _statistics(walk: RoundView) -> None:
    figures, units = round_figures(walk.content, walk.fruit), resources.settings().units
    fruit, mean = _("Fruit"), _("Mean length")
    below = {fruit: counted(figures["detections"], "detected {n} time", "detected {n} times")}
    if figures["sd_m"]:
        below[mean] = f"± {units.text(figures['sd_m'])}"
    metrics = {
        fruit: figures["fruit"],
        _("Measured"): figures["measured"],
        mean: units.text(figures["mean_m"]),
        _("Picked"): figures["picked"],
        _("Deleted"): len(walk.deleted),
    }
    page_elements.metrics(metrics, below)


def _with(view: FruitRow) -> set[str]:
    """Return which filters of *With* a fruit passes."""
    passed = {
        marked("a remark"): bool(texts.remarks(view, resources.settings().units)),
        marked("a redrawn outline"): view.corrected,
        marked("one view, not checked"): view.views == 1 and view.verdict is None,
    }
    return {name for name, passes in passed.items() if passes}


_ORDERS: dict[str, Callable[[FruitRow], float]] = {
    marked("Walk"): lambda _: 0.0,
    marked("Longest first"): lambda view: -(view.length_m or 0.0),
    marked("Shortest first"): lambda view: view.length_m or math.inf,
    marked("Least certain first"): lambda view: view.score,
}
_FILTERS: dict[str, Callable[[RoundView], Iterable[str]]] = {
    marked("Row"): lambda walk: {view.row or "" for view in walk.fruit},
    marked("Class"): lambda walk: {grade.label for grade in walk.grades.values()},
    marked("Checked"): lambda _: Verdict,
    marked("With"): lambda walk: set().union(*map(_with, walk.fruit)),
}


def _filters(walk: RoundView) -> None:
    """Draw the filters and the order; both stay while a fruit or another page is open."""
    part = page_elements.section(_("Filters"), "filter_alt", "filters")
    columns = [None] * len(_FILTERS) if part is None else part.columns(len(_FILTERS))
    for column, (label, values_in) in zip(columns, _FILTERS.items(), strict=True):
        key = f"only_{label}"
        if column is None and st.session_state.get(key) is None:
            continue
        names: dict[str | None, str] = {None: _("all")}
        names |= {name: texts.label_words(name) for name in sorted(filter(None, values_in(walk)))}
        labelled = label_options(key, names)
        if st.session_state.get(key) not in names:
            st.session_state[key] = None  # as in another round
        if column is not None:
            how: dict[str, Any] = {"format_func": labelled, "persist_state": "session"}
            column.selectbox(_(label), names, key=key, **how)
    how = {"format_func": _, "key": "only_order", "persist_state": "session"}
    st.selectbox(_("Order"), list(_ORDERS), width=320, **how)


def _listed(walk: RoundView) -> list[FruitRow]:
    """Return the fruit that pass the viewer's filters, in the order that was chosen."""
    chosen = {name: st.session_state.get(f"only_{name}") for name in _FILTERS}
    row, label, verdict, reading_filter = chosen.values()
    fruit = [
        view
        for view in (walk.deleted if verdict is Verdict.REJECTED else walk.fruit)
        if row in (None, view.row)
        and verdict in (None, view.verdict)
        and label in (None, walk.grades[view.key].label)
        and (reading_filter is None or reading_filter in _with(view))
    ]
    return sorted(fruit, key=_ORDERS[st.session_state.get("only_order", next(iter(_ORDERS)))])


def _chart(walk: RoundView, fruit: Sequence[FruitRow]) -> None:
    """Draw how long the fruit are, when it is asked for: drawing takes longer than the list."""
    measured = [view for view in fruit if hanging_lengths_m([view])]
    if not measured:
        return
    chart = page_elements.section(_("Chart of the lengths"), "bar_chart", "chart")
    if chart is not None:
        units = resources.settings().units
        lines = [
            {"length": units.value(view.length_m), "class": walk.grades[view.key].label}
            for view in measured
        ]
        words = _("Fruit on the plant: line at the mean, band of one standard deviation")
        chart.caption(words)
        from cucumbervision_greenhouse.pages import charts

        chart.altair_chart(charts.histogram(lines, units))


def _list(walk: RoundView, fruit: Sequence[FruitRow], opened: str = "") -> None:
    lines = [
        {**_line(walk, view), "picture": round_view.thumbnail_of(view)}
        for view in page_elements.first_of(fruit, "list_page", round_view.LINES)
    ]
    words = counted(len(fruit), "{n} fruit: tap one to open it", "{n} fruit: tap one to open it")
    page_elements.fruit_list("fruit_list", _("Fruit of this round"), lines, words, opened=opened)
    page_elements.draw_more(fruit, "list_page", round_view.LINES)


def _line(walk: RoundView, view: FruitRow) -> dict[str, Any]:
    units = resources.settings().units
    interval = texts.interval_words(view, units)
    position = "" if view.along_m is None else f", {texts.position_words(view.along_m, units)}"
    checked = _(_VERDICTS[view.verdict]), _("corrected") if view.corrected else ""
    picked = _("picked") if view.picked_s else ""
    says = [
        texts.today_words(view, walk.today_m.get(view.key), units)
        + (f" ({interval})" if interval else ""),
        texts.grade_words(walk.grades[view.key]),
        f"{texts.row_name(view.row)} {texts.side_words(view.side)}".strip() + position,
        ", ".join(filter(None, (*checked, picked, _("computer-made") if view.simulated else ""))),
        texts.remarks(view, units),
    ]
    return {"key": view.key, "says": says}
