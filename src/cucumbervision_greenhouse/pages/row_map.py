"""Row map: where the fruit of each row hang, and the stops of the round, to be corrected."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse.fruit_pictures import OTHER_COLORS, class_color
from cucumbervision_greenhouse.language import counted, decimal_words, language, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.page_elements import (
    button,
    do,
    draw_undo,
    picture,
    say_missing,
)
from cucumbervision_greenhouse.pages.round_choice import label_options
from cucumbervision_greenhouse.round_view import map_words, row_and_side
from cucumbervision_greenhouse.rounds.fruit_table import least_sure_first
from cucumbervision_greenhouse.rounds.merge_and_link import move_stop
from cucumbervision_greenhouse.rounds.walking import sides_of
from cucumbervision_greenhouse.store.records import Verdict
from cucumbervision_greenhouse.words import label_words, ready_words, side_words, stop_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision_greenhouse.round_view import GradedRound
    from cucumbervision_greenhouse.settings import Units
    from cucumbervision_greenhouse.store.records import FruitRow, Round, StopRecord


_ROWS_AT_ONCE = 4


@page_elements.of_round
def page(round_summary: Round) -> None:
    """Draw the page."""
    maps, undo = st.container(), st.container()
    list_stops(round_summary)  # first, since a stop on a third side prevents drawing the map
    with undo:
        draw_undo(round_summary.key)
    with maps:
        opened = _opened(round_summary)
        groups = round_view.content_of(round_summary).group_of
        page_elements.say_missing(
            "fruit", groups, _("There is no such fruit in this round (any more).")
        )
        _maps(round_summary, opened)


def _maps(round_summary: Round, opened: FruitRow | None) -> None:
    units = resources.settings().units
    graded = round_view.graded_round(round_summary)
    lines = round_view.map_lines_of(round_summary, units, language())
    if not lines:
        st.info(
            _("No fruit of this round has a position yet. Enter row and position when capturing."),
            icon=":material/map:",
        )
        return
    by, where = st.columns([2, 3], vertical_alignment="bottom")
    st.session_state.setdefault("color_by", "class")
    scales = {"class": _("Class"), "length": _("Length")}
    colored = by.segmented_control(
        _("Colour by"),
        list(scales),
        format_func=lambda name: scales.get(name, name),
        key="color_by",
        required=True,
    )
    rows = sorted({line["row"] for line in lines})
    chosen = where.pills(
        _("Rows and sides"),
        rows,
        default=rows[:_ROWS_AT_ONCE],
        format_func=plain,
        selection_mode="multi",
    )
    named = None if opened is None else row_and_side(opened)
    drawn = [row for row in rows if row in chosen or row == named]
    drawn_lines = [line for line in lines if line["row"] in drawn]
    abreast = st.columns(min(2, max(len(drawn), 1)))
    for number, row in enumerate(drawn):
        with abreast[number % len(abreast)]:
            st.caption(plain(row))
            row_lines = [line for line in drawn_lines if line["row"] == row]
            layers, grid = map_picture(row_lines, drawn_lines, units, by_length=colored == "length")
            opened_here = opened if row == named else None
            _row(
                round_summary,
                row,
                layers,
                {"row": row, "grid": grid, "opened": opened_here and _answer(graded, opened_here)},
            )
    st.caption(
        _(
            "One mark per fruit: a cross if it was picked, a diamond if it is computer-made, pale "
            "if it was seen from one stop only. Tap a mark to see the fruit. Heights are relative "
            "to the camera."
        )
    )
    if (ready := round_view.ready_today(round_summary)) is not None:
        st.caption(ready_words(ready))
    _doubtful(graded)


def _row(
    round_summary: Round, row: str, layers: list[dict[str, Any]], content: dict[str, object]
) -> None:
    """Draw a row's map; a tap opens the fruit beside its mark, where it can be judged."""
    key = f"map_{round_summary.key}_{row}"

    def tapped() -> None:
        page_elements.name_in_address("fruit", st.session_state[key].tapped or None)

    def judged() -> None:
        asked = st.session_state[key].judged
        views = _views_of(round_summary, asked["key"])
        if views and asked["act"] != "open":
            verdict = Verdict(asked["act"])
            do(partial(resources.store().set_verdict, [view.key for view in views], verdict))

    told = picture(
        key,
        {},
        MAP_PX,
        layers=layers,
        title=_("Map of {row}").format(row=row),
        content=content,
        on={"tapped": tapped, "judged": judged},
    )
    if told.judged and told.judged["act"] == "open":
        page_elements.leave_for("results", fruit=told.judged["key"])


def _answer(graded: GradedRound, fruit: FruitRow) -> dict[str, Any]:
    """Return the words for a fruit beside its mark."""
    units = resources.settings().units
    verdicts = {
        None: "",
        Verdict.ACCEPTED: f". {_('Marked: a fruit.')}",
        Verdict.REJECTED: f". {_('Marked: not a fruit.')}",
    }
    return {
        "key": fruit.key,
        "picture": round_view.thumbnail_of(fruit),
        "says": map_words(fruit, graded, units) + verdicts[fruit.verdict],
        "verdict": fruit.verdict,
    }


def _opened(round_summary: Round) -> FruitRow | None:
    views = _views_of(round_summary, st.query_params.get("fruit", ""))
    return next((view for view in views if view.best), None)


def _views_of(round_summary: Round, key: str) -> list[FruitRow]:
    """Return all views of the fruit of one of them, as they are in the store now."""
    views = resources.store().detections(round_summary.key)
    groups = {view.group for view in views if view.key == key}
    return [view for view in views if view.group in groups]


def _doubtful(graded: GradedRound) -> None:
    unsure = least_sure_first(graded.fruit)
    if not unsure:
        return

    def look() -> None:
        keys = [view.key for view in unsure]
        current = st.query_params.get("fruit")
        index = keys.index(current) + 1 if current in keys else 0
        page_elements.name_in_address("fruit", keys[index % len(keys)])

    words = counted(
        len(unsure),
        "{n} fruit was seen from one stop only: may be wrong or counted twice.",
        "{n} fruit were seen from one stop only: may be wrong or counted twice.",
    )
    says, go = st.columns([3, 2], vertical_alignment="center")
    says.markdown(words)
    button(go, _("Show the least certain"), "visibility", look)


MAP_PX = 1000, 560
"""Width and height of a row's map, in its own pixels."""

_MAP_EDGE_PX = 50
# From viridis: lighter with increasing length.
_STEP_COLORS = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")


def map_picture(
    lines: list[dict[str, Any]], all_lines: list[dict[str, Any]], units: Units, *, by_length: bool
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the fruit of one row and side as layers of a picture of `MAP_PX`, and its grid.

    Parameters
    ----------
    lines : list of dict
        The fruit, as `round_view.map_lines` gives them.
    all_lines : list of dict
        All that are shown, which the scales fit.
    by_length : bool
        A layer for every step of the length; else one a class.

    Returns
    -------
    layers : list of dict
        As `page_elements.picture` takes them, with 'marks': of each fruit x and y, key, words,
        kind of mark, and whether it was seen once.
    grid : dict
        Lines 'across' and 'up' with their words.
    """
    ends = {name: _ends(all_lines, name) for name in ("along", "height")}

    def place(name: str, value: float) -> float:
        (start, end), size = ends[name], MAP_PX[name == "height"]
        share = (value - start) / max(end - start, 0.1)
        across = _MAP_EDGE_PX + share * (size - 2 * _MAP_EDGE_PX)
        return round(size - across if name == "height" else across, 1)

    by_class = {name: _class(name) for name in {line["class"] for line in lines}}
    layers: dict[str, dict[str, Any]] = {}
    for line in sorted(lines, key=lambda line: line["length"] or 0.0):
        name, color = _length_step(line["length"], units) if by_length else by_class[line["class"]]
        layer = layers.setdefault(
            name, {"name": name, "color": color, "on": True, "shapes": [], "marks": []}
        )
        # Without names: a round has thousands of them.
        at = place("along", line["along"]), place("height", line["height"])
        layer["marks"].append((*at, line["key"], line["says"], line["mark"], line["views"] == 1))
    grid = {
        name: [
            (place(axis, value), f"{decimal_words(f'{value:g}')} {units.along[0]}")
            for value in _round_values(*ends[axis])
        ]
        for name, axis in (("across", "along"), ("up", "height"))
    }
    return list(layers.values()), grid


def _class(name: str) -> tuple[str, str]:
    return label_words(name), class_color(name)


def _length_step(length: float | None, units: Units) -> tuple[str, str]:
    """Return the name and colour of the step of 5 cm or 2 inches that a length is in."""
    if length is None:
        return _("not measured"), OTHER_COLORS["not measured"]
    step = 5 if units.name == "cm" else 2
    number = int(length // step)
    high = f"{(number + 1) * step} {units.name}"
    name = _("{low} to {high}").format(low=number * step, high=high)
    return name, _STEP_COLORS[min(max(number - 1, 0), len(_STEP_COLORS) - 1)]


def _round_values(first_value: float, last_value: float) -> list[float]:
    """Return round values between two ends, at most ten.

    Examples
    --------
    >>> _round_values(-0.31, 0.42), _round_values(0.2, 23.9)
    ([-0.2, 0.0, 0.2, 0.4], [5.0, 10.0, 15.0, 20.0])
    """
    steps = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
    step = next((s for s in steps if (last_value - first_value) / s <= 5), 100.0)
    first, last = math.ceil(first_value / step), math.floor(last_value / step)
    return [round(k * step, 1) for k in range(first, last + 1)]


def _ends(lines: list[dict[str, Any]], name: str) -> tuple[float, float]:
    values = [float(line[name]) for line in lines if line[name] is not None] or [0.0]
    return min(values), max(values)


# Kinds of action by which others must not take away what is being typed.
_OF_FRUIT = (
    *("accept", "reject", "clear", "pick", "unpick", "correct", "add"),
    *("merge", "unmerge", "link-growth", "unlink-growth"),
)


def list_stops(round_summary: Round) -> None:
    """Draw the choice of a stop, and the form that corrects it."""
    stops = {stop.key: stop for stop in resources.store().stops(round_summary.key)}
    key = f"stop_of_{round_summary.key}"
    named = st.query_params.get("stop")  # as the capture page's link does
    say_missing("stop", stops, _("There is no such stop in this round (any more)."))
    if named in stops:
        st.session_state.setdefault(key, named)
    title = _("Stops: move, rename, delete")
    part = page_elements.section(title, "place", "stops", opened=named in stops)
    if part is None:
        return
    with part:
        chosen = st.selectbox(
            _("Stop"),
            list(stops),
            index=None,
            format_func=label_options(key, {index: _words(stop) for index, stop in stops.items()}),
            placeholder=counted(len(stops), "Choose one of {n} stop", "Choose one of {n} stops"),
            key=key,
        )
        if chosen in stops:
            change_stop(stops[chosen], sides_of(stops.values()))


def _words(stop: StopRecord) -> str:
    note = f" ({stop.note})" if stop.note else ""
    name = stop_name(stop, resources.settings().units)
    return f"{name}{note} · {counted(stop.fruit, '{n} fruit', '{n} fruit')}"


def change_stop(stop: StopRecord, sides: Sequence[str]) -> None:
    """Draw a stop's place and name to be changed; `sides` are those of its round."""
    store = resources.store()
    # Fields of new names after each change of a stop: those on the page keep what was typed.
    version = f"{stop.key}_{store.newest_action(stop.round_key, without=_OF_FRUIT)}"
    row, side, position = st.columns(3)
    number, note = st.columns([1, 2])
    row.text_input(_("Row"), stop.row or "", key=f"stop_row_{version}")
    choices = list(dict.fromkeys([*sides, *filter(None, [stop.side])]))
    index = choices.index(stop.side) if stop.side else None
    side.selectbox(
        _("Side"),
        choices,
        index,
        format_func=side_words,
        key=f"stop_side_{version}",
        accept_new_options=True,
    )
    unit, per_metre = resources.settings().units.along
    at = None if stop.position_m is None else stop.position_m * per_metre
    position.number_input(
        _("At [{unit}]").format(unit=unit),
        min(0.0, at or 0.0),
        None,
        at,
        0.1,
        "%.2f",
        key=f"stop_at_{version}",
    )
    number.number_input(_("Number"), None, None, stop.step, 1, key=f"stop_step_{version}")
    note.text_input(_("Name"), stop.note, key=f"stop_note_{version}")

    def move() -> int:
        # What the fields hold now: they may have been typed into since they were drawn.
        names = ("row", "side", "at", "step", "note")
        typed = [st.session_state[f"stop_{name}_{version}"] for name in names]
        row, side, note = ((typed[k] or "").strip() for k in (0, 1, 4))
        at_m = None if typed[2] is None else typed[2] / per_metre
        return move_stop(store, stop, Stop(row or None, side or None, at_m, typed[3]), note)

    def remove() -> int:
        return store.delete_stop(stop.key)

    save, delete = st.columns(2)
    for where, label, icon, act in (
        (save, _("Save"), "save", move),
        (delete, _("Delete this stop"), "delete", remove),
    ):
        button(where, label, icon, _do, stop.round_key, act, key=f"{icon}_{stop.key}")


def _do(round_key: str, act: Callable[[], int]) -> None:
    """Do it, and find the round's fruit anew."""
    if do(act):
        tasks.merge(round_key)
