"""Accuracy: lengths measured by hand beside the program's, and calibrations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.accuracy.own_truth import OwnTruth, evaluate_lengths
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_greenhouse import resources, round_caches
from cucumbervision_greenhouse.core_words import words_of
from cucumbervision_greenhouse.language import decimal_words, marked, number_words, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import calibrations, page_elements
from cucumbervision_greenhouse.pages.hand_lengths import (
    LENGTHS,
    hand_file,
    hand_lengths,
    is_odd,
    measured_round,
    truth_of,
    typed_m,
    write_hand_lengths,
)
from cucumbervision_greenhouse.pages.page_elements import component
from cucumbervision_greenhouse.pages.site_calibrations import bias_words
from cucumbervision_greenhouse.words import length_words, position_words

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from cucumbervision_greenhouse.store.records import FruitRow, Round

_LINES = 30
_KINDS = {
    LengthDefinition.CENTRELINE: marked("Centreline"),
    LengthDefinition.THREAD: marked("Thread"),
    LengthDefinition.CHORD: marked("Chord"),
}


@page_elements.of_round
def page(round_summary: Round) -> None:
    """Draw the page."""
    graded = round_caches.graded_round(round_summary)
    fruit = [view for view in graded.fruit if view.length_m is not None]
    own_fruit, grid, saved = st.tabs([_("Own fruit"), _("Printed grid"), _("Calibrations")])
    with own_fruit:
        _own_fruit(round_summary, fruit)
    with grid:
        calibrations.draw_grid(round_summary)
    with saved:
        calibrations.draw_choice()


def _own_fruit(round_summary: Round, fruit: list[FruitRow]) -> None:
    if not fruit:
        st.info(_("This round has no measured fruit yet."), icon=":material/straighten:")
        return
    st.write(
        _(
            "Measure some fruit by hand and enter the lengths here: then you see how far the "
            "lengths are off on your fruit. Measure some of them twice, without looking at the "
            "first value: no method can be shown to be more accurate than the measurements by hand."
        )
    )
    path = hand_file(resources.where(), round_summary.key)
    _table(fruit, path)
    if path.exists():
        _scores(round_summary, path)


def _table(fruit: list[FruitRow], path: Path) -> None:
    units = resources.settings().units
    saved = hand_lengths(path, fruit)
    page_elements.choose_page(fruit, "hand_page", _LINES)
    page_fruit = page_elements.page_of(fruit, "hand_page", _LINES)
    kind = st.segmented_control(
        _("Measured by hand"),
        list(LengthDefinition),
        format_func=lambda x: _(_KINDS[x]),
        default=LengthDefinition.CENTRELINE,
        required=True,
        help=_("Thread: laid over the outer side, from end to end. Chord: with calipers."),
    )
    st.caption(_("Lengths in {unit}.").format(unit=units.name))
    name = f"hand_{path.stem}_{units.name}"
    typed: dict[str, list[str | None]] = st.session_state.setdefault(f"{name}_typed", {})
    key = f"{name}_{page_fruit[0].key}"
    component("handlist")(
        key=key,
        data={
            "lines": [_line(view, saved.get(view.key, (None, None))) for view in page_fruit],
            "typed": typed,
            "least": LENGTHS[0],
            "most": LENGTHS[1],
        },
        default={"typed": {}},
        on_typed_change=lambda: typed.update(st.session_state[key].typed or {}),
    )
    bad = _read(typed, saved)
    if bad:
        words = _("{typed}: no length between {least} and {most}.")
        st.warning(
            plain(words.format(typed=", ".join(bad), least=LENGTHS[0], most=LENGTHS[1])),
            icon=":material/error:",
        )
    odd = [
        _("{by_hand} by hand, {length} by the program").format(
            by_hand=units.text(hand_m), length=length_words(view, units)
        )
        for view in fruit
        for hand_m in saved.get(view.key, ())
        if is_odd(view, hand_m)
    ]
    if odd:
        words = _("{lengths}. Is that right?").format(lengths=plain("; ".join(odd)))
        st.warning(words, icon=":material/help:")
        odd = [] if st.checkbox(_("Yes, these lengths are right"), key=f"sure_{odd}") else odd
    unsure = bool(odd or bad)  # also if the button was pressed before the check
    save: dict[str, Any] = {"type": "primary", "icon": ":material/save:", "disabled": unsure}
    if st.button(_("Save these lengths"), **save) and not unsure:
        if not write_hand_lengths(path, fruit, saved, kind or LengthDefinition.CENTRELINE):
            path.unlink()  # every length was taken out again
        typed.clear()
        st.rerun()


def _read(
    typed: Mapping[str, Sequence[str | None]], saved: dict[str, tuple[float | None, float | None]]
) -> list[str]:
    """Add typed values to the saved lengths; return those that are not lengths."""
    units, bad = resources.settings().units, list[str]()
    for key, cells in typed.items():
        lengths = list(saved.get(key, (None, None)))
        for index, cell in enumerate(cells[:2]):
            if cell is None:  # not typed: it may have been saved by another viewer meanwhile
                continue
            try:
                lengths[index] = typed_m(str(cell), units)
            except ValueError:
                bad.append(str(cell))
        saved[key] = lengths[0], lengths[1]
    return bad


def _line(view: FruitRow, saved_m: tuple[float | None, float | None]) -> dict[str, Any]:
    units = resources.settings().units
    position = position_words(view.along_m, units) if view.along_m is not None else ""
    return {
        "key": view.key,
        "picture": round_caches.thumbnail_of(view),
        "saved": ["" if x is None else decimal_words(f"{units.value(x):.5g}") for x in saved_m],
        "program": units.text(view.length_m),
        "name": _("fruit {number}, {place}").format(
            number=view.fruit, place=position or view.capture
        ),
        "at": position,
        "row": view.row or "?",
    }


def _scores(round_summary: Round, path: Path) -> None:
    measured = measured_round(resources.store(), round_summary.key)
    truth = truth_of(path, measured)
    if not truth.lengths:
        return
    own_truth: OwnTruth = evaluate_lengths(measured, truth)
    st.header(_("Errors"))
    st.markdown(f"**{plain(bias_words(own_truth, resources.settings().units))}**")
    with st.expander(_("Details: errors by method"), icon=":material/list:"):
        _methods(own_truth)
    st.header(_("Calibrate this site"))
    calibrations.draw_own_fruit(measured, truth)


def _methods(own_truth: OwnTruth) -> None:
    lines = [
        {
            _("Method"): score.method,
            _("Against"): _(_KINDS[score.kind]),
            _("Fruit"): score.fruit,
            _("Mean absolute error"): f"{number_words(score.metrics.mape_percent, 1)} %",
            "95 %": _("needs 3 fruit")
            if score.low_percent != score.low_percent
            else _("{low} to {high}").format(
                low=number_words(score.low_percent, 1),
                high=f"{number_words(score.high_percent, 1)} %",
            ),
            _("Measured"): f"{100 * score.metrics.measured:.0f} %",
        }
        for score in own_truth.scores
    ]
    page_elements.table(lines)
    if any(score.metrics.measured < 1 for score in own_truth.scores):
        st.caption(_("A fruit that a method did not measure counts as an error of 100 %."))
    for note in own_truth.notes:
        st.caption(plain(words_of(note)))
