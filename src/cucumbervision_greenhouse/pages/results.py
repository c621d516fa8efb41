"""Results: the statistics of a round, its fruit in a table, its files, and each fruit by itself."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import streamlit as st

from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.language import counted, marked, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import fruit as fruit_page
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.round_choice import label_options
from cucumbervision_greenhouse.round_view import GradedRound
from cucumbervision_greenhouse.rounds.fruit_table import hanging_lengths_m, on_the_plant
from cucumbervision_greenhouse.rounds.walking import is_demonstration
from cucumbervision_greenhouse.store.records import Verdict
from cucumbervision_greenhouse.words import (
    grade_words,
    interval_words,
    label_words,
    position_words,
    ready_words,
    remarks,
    row_name,
    side_words,
    today_words,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision_greenhouse.store.records import FruitRow, Round

_FORMATS = {
    ExportFormat.XLSX: marked("Excel"),
    ExportFormat.CSV: "CSV",
    ExportFormat.HTML: marked("Page to print"),
    ExportFormat.PARQUET: marked("Parquet"),
    ExportFormat.JSON: "JSON",
}


def _files(round_summary: Round) -> None:
    """Draw the choice of formats, and the link that makes and loads the files."""
    formats = st.pills(
        _("Formats"),
        list(_FORMATS),
        format_func=lambda name: _(_FORMATS[name]),
        selection_mode="multi",
        default=[ExportFormat.XLSX, ExportFormat.CSV, ExportFormat.HTML],
        key="formats",
    )
    if formats:
        asked = urlencode([("formats", str(chosen)) for chosen in formats])
        st.html(
            f'<a class="load" href="/api/files/{round_summary.key}?{asked}" download>'
            f"{_('Download')}</a>"
        )


_VERDICTS = {
    None: "",
    Verdict.ACCEPTED: marked("✓ accepted"),
    Verdict.REJECTED: marked("✗ not a fruit"),
}


@page_elements.of_round
def page(round_summary: Round) -> None:
    """Draw the page."""
    graded = round_view.graded_round(round_summary)
    groups = round_view.content_of(round_summary).group_of
    opened = groups.get(st.query_params.get("fruit", ""))  # by any of its views
    if opened is not None and opened in graded.grades:
        fruit_page.show(round_summary, graded, opened, _listed(graded))
        return
    page_elements.say_missing(
        "fruit", groups, _("There is no such fruit in this round (any more).")
    )
    if not (graded.fruit or graded.deleted):
        _empty(round_summary)
        return
    _classes(round_summary, graded)
    _statistics(graded)
    _filters(graded)
    fruit = _listed(graded)
    if not fruit:
        st.info(_("No fruit matches these filters."), icon=":material/filter_alt_off:")
        return
    _list(graded, fruit)
    _chart(graded, fruit)
    files = page_elements.section(_("Files of this round"), "download", "files")
    if files is not None:
        with files:
            _files(round_summary)


def _empty(round_summary: Round) -> None:
    if not round_summary.stops and (words := tasks.progress(round_summary.key).first_words):
        st.info(words, icon=":material/hourglass_empty:")
    elif round_summary.stops:
        st.info(_("No fruit was found at the stops of this round."), icon=":material/search_off:")
    else:
        page_elements.first_steps(begun=True)


def _classes(round_summary: Round, graded: GradedRound) -> None:
    """Say first what a grower asks first: how many of each class, and where the list is."""
    counts = Counter(graded.grades[view.key].label for view in on_the_plant(graded.fruit))
    words = ", ".join(f"{number} {label_words(name)}" for name, number in sorted(counts.items()))
    says, go = st.columns([3, 1], vertical_alignment="center")
    says.markdown(f"**{plain(words or _('No fruit on the plant'))}**")
    if (ready := round_view.ready_today(round_summary)) is not None:
        says.caption(ready_words(ready))
    if is_demonstration(round_summary.key):
        says.caption(_("A computer-made example."))
    with go:
        page_elements.link("today", _("What is ready today"))


def _statistics(graded: GradedRound) -> None:
    figures, units = graded.figures, resources.settings().units
    metrics: dict[str, tuple[int | str, str | None]] = {
        _("Fruit"): (
            figures.fruit,
            counted(figures.detections, "detected {n} time", "detected {n} times"),
        ),
        _("Measured"): (figures.measured, None),
        _("Mean length"): (
            units.text(figures.mean_m),
            f"± {units.text(figures.sd_m)}" if figures.sd_m else None,
        ),
        _("Picked"): (figures.picked, None),
        _("Deleted"): (len(graded.deleted), None),
    }
    how: dict[str, Any] = {"delta_color": "off", "delta_arrow": "off", "width": "content"}
    with st.container(horizontal=True):
        for label, (value, below) in metrics.items():
            st.metric(label, value, below, **how)


def _with(view: FruitRow) -> set[str]:
    """Return which filters of *With* a fruit passes."""
    passed = {
        marked("a remark"): bool(remarks(view, resources.settings().units)),
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
_WALK, _LIST, _PICTURES = next(iter(_ORDERS)), marked("List"), marked("Pictures")


_FILTERS: dict[str, Callable[[GradedRound], Iterable[str]]] = {
    marked("Row"): lambda graded: {view.row or "" for view in graded.fruit},
    marked("Class"): lambda graded: {grade.label for grade in graded.grades.values()},
    marked("Checked"): lambda _: Verdict,
    marked("With"): lambda graded: set().union(*map(_with, graded.fruit)),
}


def _filters(graded: GradedRound) -> None:
    """Draw the filters and the order; both stay while a fruit or another page is open."""
    part = page_elements.section(_("Filters"), "filter_alt", "filters")
    columns = [None] * len(_FILTERS) if part is None else part.columns(len(_FILTERS))
    for column, (label, values_in) in zip(columns, _FILTERS.items(), strict=True):
        key = f"only_{label}"
        if column is None and st.session_state.get(key) is None:
            continue
        names: dict[str | None, str] = {None: _("all")}
        names |= {name: label_words(name) for name in sorted(filter(None, values_in(graded)))}
        labelled = label_options(key, names)
        if st.session_state.get(key) not in names:
            st.session_state[key] = None  # as in another round
        if column is not None:
            column.selectbox(_(label), names, format_func=labelled, key=key)
    order, drawn = st.columns([3, 2], vertical_alignment="bottom")
    for name, usual in (("only_order", _WALK), ("only_drawn", _LIST)):
        st.session_state.setdefault(name, usual)
    order.selectbox(_("Order"), list(_ORDERS), format_func=_, key="only_order")
    drawn.segmented_control(
        _("Fruit as"), [_LIST, _PICTURES], format_func=_, key="only_drawn", required=True
    )


def _listed(graded: GradedRound) -> list[FruitRow]:
    """Return the fruit that pass the viewer's filters, in the order that was chosen."""
    chosen = {name: st.session_state.get(f"only_{name}") for name in _FILTERS}
    row, label, verdict, reading_filter = chosen.values()
    fruit = [
        view
        for view in (graded.deleted if verdict is Verdict.REJECTED else graded.fruit)
        if row in (None, view.row)
        and verdict in (None, view.verdict)
        and label in (None, graded.grades[view.key].label)
        and (reading_filter is None or reading_filter in _with(view))
    ]
    return sorted(fruit, key=_ORDERS[st.session_state.get("only_order", _WALK)])


def _chart(graded: GradedRound, fruit: Sequence[FruitRow]) -> None:
    """Draw how long the fruit are, when it is asked for: drawing takes longer than the list."""
    if not any(hanging_lengths_m([view]) for view in fruit):
        return
    chart = page_elements.section(_("Chart of the lengths"), "bar_chart", "chart")
    if chart is not None:
        units = resources.settings().units
        lines = round_view.length_lines(fruit, graded.grades, units)
        words = _("Fruit on the plant: line at the mean, band of one standard deviation")
        chart.caption(words)
        from cucumbervision_greenhouse.pages import charts

        chart.altair_chart(charts.histogram(lines, units))


def _list(graded: GradedRound, fruit: Sequence[FruitRow]) -> None:
    page_fruit = page_elements.page_of(fruit, "list_page", round_view.LINES)
    are_pictures = st.session_state.get("only_drawn") == _PICTURES
    picture_of = round_view.cutout_of if are_pictures else round_view.thumbnail_of
    lines = [{**_line(graded, view), "picture": picture_of(view)} for view in page_fruit]
    words = counted(len(fruit), "{n} fruit: tap one to open it", "{n} fruit: tap one to open it")
    page_elements.fruit_list(
        "fruit_list", _("Fruit of this round"), lines, words, are_pictures=are_pictures
    )
    page_elements.choose_page(fruit, "list_page", round_view.LINES)


def _line(graded: GradedRound, view: FruitRow) -> dict[str, Any]:
    units, record = resources.settings().units, view
    interval = interval_words(record, units)
    position = "" if view.along_m is None else f", {position_words(view.along_m, units)}"
    checked = _(_VERDICTS[view.verdict]), _("corrected") if view.corrected else ""
    picked = _("picked") if view.picked_s else ""
    says = [
        today_words(record, graded.today_m.get(view.key), units)
        + (f" ({interval})" if interval else ""),
        grade_words(graded.grades[view.key]),
        f"{row_name(view.row)} {side_words(view.side)}".strip() + position,
        ", ".join(filter(None, (*checked, picked, _("computer-made") if view.simulated else ""))),
        remarks(record, units),
    ]
    return {"key": view.key, "says": says}
