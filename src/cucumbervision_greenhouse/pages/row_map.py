"""Row map: where the fruit of each row hang, and the stops of the round, to be corrected."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import streamlit as st

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.fruit_pictures import OTHER_COLORS, class_color
from cucumbervision_greenhouse.language import counted, decimal_words, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.round_choice import label_options
from cucumbervision_greenhouse.rounds.fruit_table import least_sure_first
from cucumbervision_greenhouse.rounds.merge_and_link import move_stop
from cucumbervision_greenhouse.rounds.walking import sides_of
from cucumbervision_greenhouse.store.records import Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from cucumbervision.crop.grades import Grade
    from cucumbervision_greenhouse.round_view import RoundView
    from cucumbervision_greenhouse.settings import Units
    from cucumbervision_greenhouse.store.records import FruitRow, StopRecord


_ROWS_AT_ONCE = 4


@page_elements.of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    maps, undo = st.container(), st.container()
    list_stops(walk.key)  # first, since a stop on a third side prevents drawing the map
    with undo:
        page_elements.draw_undo(walk.key)
    with maps:
        groups = walk.content.group_of
        page_elements.say_missing(
            "fruit", groups, _("There is no such fruit in this round (any more).")
        )
        key = groups.get(st.query_params.get("fruit", ""))
        _maps(walk, next((fruit for fruit in walk.best if fruit.group == key), None))


def _maps(walk: RoundView, opened: FruitRow | None) -> None:
    placed = [fruit for fruit in walk.fruit if fruit.along_m is not None]
    if not placed:
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
    rows = sorted({texts.row_and_side(fruit) for fruit in placed})
    chosen = where.pills(
        _("Rows and sides"),
        rows,
        default=rows[:_ROWS_AT_ONCE],
        format_func=plain,
        selection_mode="multi",
    )
    named = None if opened is None else texts.row_and_side(opened)
    rows_drawn = [row for row in rows if row in chosen or row == named]
    drawn = [fruit for fruit in placed if texts.row_and_side(fruit) in rows_drawn]
    abreast = st.columns(min(2, max(len(rows_drawn), 1)))
    for number, row in enumerate(rows_drawn):
        with abreast[number % len(abreast)]:
            st.caption(plain(row))
            of_row = [fruit for fruit in drawn if texts.row_and_side(fruit) == row]
            by_length = colored == "length"
            layers, grid = map_picture(of_row, drawn, walk.grades, by_length=by_length)
            answer = _answer(walk, opened) if opened is not None and row == named else None
            _row(walk, row, layers, {"row": row, "grid": grid, "opened": answer})
    st.caption(
        _(
            "One mark per fruit: a cross if it was picked, a diamond if it is computer-made, pale "
            "if it was seen from one stop only. Tap a mark to see the fruit. Heights are relative "
            "to the camera."
        )
    )
    if (ready := walk.ready) is not None:
        st.caption(texts.ready_words(ready))
    _doubtful(walk.fruit)


def _row(
    walk: RoundView, row: str, layers: list[dict[str, Any]], content: dict[str, object]
) -> None:
    """Draw a row's map; a tap opens the fruit beside its mark, where it can be judged."""
    key = f"map_{walk.key}_{row}"

    def tapped() -> None:
        page_elements.name_in_address("fruit", st.session_state[key].tapped or None)

    def judged() -> None:
        asked = st.session_state[key].judged
        if asked["act"] != "open":
            page_elements.do(
                partial(page_elements.judge, walk.key, asked["key"], Verdict(asked["act"]))
            )

    drawn = page_elements.picture(
        key,
        {},
        MAP_PX,
        layers=layers,
        title=_("Map of {row}").format(row=row),
        content=content,
        on={"tapped": tapped, "judged": judged},
    )
    if drawn.judged and drawn.judged["act"] == "open":
        page_elements.leave_for("results", fruit=drawn.judged["key"])


def _answer(walk: RoundView, fruit: FruitRow) -> dict[str, Any]:
    """Return the words for a fruit beside its mark."""
    verdicts = {
        None: "",
        Verdict.ACCEPTED: f". {_('Marked: a fruit.')}",
        Verdict.REJECTED: f". {_('Marked: not a fruit.')}",
    }
    words = f"{texts.row_and_side(fruit)}, {_mark_words(fruit, walk.grades)}"
    return {
        "key": fruit.key,
        "picture": round_view.thumbnail_of(fruit),
        "says": words + verdicts[fruit.verdict],
        "verdict": fruit.verdict,
    }


def _mark_words(fruit: FruitRow, grades: Mapping[str, Grade]) -> str:
    units = resources.settings().units
    place, length = texts.position_words(fruit.along_m, units), texts.length_words(fruit, units)
    return f"{place}: {length}, {texts.grade_words(grades[fruit.key])}"


def _doubtful(fruit: Sequence[FruitRow]) -> None:
    unsure = least_sure_first(fruit)
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
    page_elements.button(go, _("Show the least certain"), "visibility", look)


MAP_PX = 1000, 560
"""Width and height of a row's map, in its own pixels."""

_MAP_EDGE_PX = 50
# From viridis: lighter with increasing length.
_STEP_COLORS = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")


def map_picture(
    fruit: Sequence[FruitRow],
    drawn: Sequence[FruitRow],
    grades: Mapping[str, Grade],
    *,
    by_length: bool,
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the fruit of one row and side as layers of a picture of `MAP_PX`, and its grid.

    Parameters
    ----------
    fruit : sequence of FruitRow
        The fruit, each with a position.
    drawn : sequence of FruitRow
        All that are shown, which the scales fit.
    grades : mapping of str to Grade
        By the keys of the fruit.
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
    units = resources.settings().units
    unit, per_metre = units.along
    places = [_place(view) for view in drawn]
    lowest, highest = np.min(places, axis=0), np.max(places, axis=0)
    size_px, edge_px = np.array(MAP_PX), _MAP_EDGE_PX
    scale = (size_px - 2 * edge_px) / np.maximum(highest - lowest, 0.1 / per_metre)

    def at_px(place_m: Sequence[float]) -> list[float]:
        x, y = edge_px + (np.array(place_m) - lowest) * scale
        return [round(float(x), 1), round(float(MAP_PX[1] - y), 1)]

    layers: dict[str, dict[str, Any]] = {}
    for view in sorted(fruit, key=lambda view: view.length_m or 0.0):
        label = grades[view.key].label
        name, color = texts.label_words(label), class_color(label)
        if by_length:
            name, color = _length_step(units.value(view.length_m), units)
        layer = layers.setdefault(
            name, {"name": name, "color": color, "on": True, "shapes": [], "marks": []}
        )
        kind = "picked" if view.picked_s is not None else "simulated" if view.simulated else "seen"
        # Without names: a round has thousands of them.
        mark = *at_px(_place(view)), view.key, _mark_words(view, grades), kind, view.views == 1
        layer["marks"].append(mark)
    grid = {}
    for axis, name in enumerate(("across", "up")):
        values = _round_values(*(float(end[axis]) * per_metre for end in (lowest, highest)))
        grid[name] = [
            (at_px([value / per_metre] * 2)[axis], f"{decimal_words(f'{value:g}')} {unit}")
            for value in values
        ]
    return list(layers.values()), grid


def _place(fruit: FruitRow) -> tuple[float, float]:
    """Return where a fruit is drawn: metres along the row and above the camera."""
    return max(fruit.along_m or 0.0, 0.0), -(fruit.centre_y_m or 0.0)


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


def list_stops(round_key: str) -> None:
    """Draw the choice of a stop, and the form that corrects it."""
    stops = {stop.key: stop for stop in resources.store().stops(round_key)}
    key = f"stop_of_{round_key}"
    named = st.query_params.get("stop")  # as the capture page's link does
    missing = _("There is no such stop in this round (any more).")
    page_elements.say_missing("stop", stops, missing)
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
    name = texts.stop_name(stop, resources.settings().units)
    return f"{name}{note} · {counted(stop.fruit, '{n} fruit', '{n} fruit')}"


def change_stop(stop: StopRecord, sides: Sequence[str]) -> None:
    """Draw a stop's place and name to be changed; `sides` are those of its round.

    A change of the stop by others draws new fields; any other change keeps what was typed.
    """
    unit, per_metre = resources.settings().units.along
    at = None if stop.position_m is None else stop.position_m * per_metre
    names = list(dict.fromkeys([*sides, *filter(None, [stop.side])]))
    index = names.index(stop.side) if stop.side else None
    drawn = f"{stop.key}_{hash((stop.row, stop.side, at, stop.step, stop.note))}"
    keys = {name: f"stop_{name}_{drawn}" for name in ("row", "side", "at", "step", "note")}

    def move() -> int:
        # What the fields hold now: they may have been typed into since they were drawn.
        row, side, at, step, note = (st.session_state[key] for key in keys.values())
        at_m = None if at is None else at / per_metre
        place = Stop(row.strip() or None, (side or "").strip() or None, at_m, step)
        return move_stop(resources.store(), stop, place, note.strip())

    def remove() -> int:
        return resources.store().delete_stop(stop.key)

    row, side, position = st.columns(3)
    number, note = st.columns([1, 2])
    row.text_input(_("Row"), stop.row or "", key=keys["row"])
    how: dict[str, Any] = {"format_func": texts.side_words, "accept_new_options": True}
    side.selectbox(_("Side"), names, index, key=keys["side"], **how)
    label, lowest = _("At [{unit}]").format(unit=unit), min(0.0, at or 0.0)
    position.number_input(label, lowest, None, at, 0.1, "%.2f", key=keys["at"])
    number.number_input(_("Number"), None, None, stop.step, 1, key=keys["step"])
    note.text_input(_("Name"), stop.note, key=keys["note"])
    save, delete = st.columns(2)
    page_elements.button(save, _("Save"), "save", _do, stop.round_key, move)
    page_elements.button(delete, _("Delete this stop"), "delete", _do, stop.round_key, remove)


def _do(round_key: str, act: Callable[[], int]) -> None:
    """Do it, and find the round's fruit anew."""
    if page_elements.do(act):
        tasks.merge(round_key)
