"""Accuracy: lengths measured by hand beside the program's, their table, and calibrations."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import streamlit as st

from cucumbervision.accuracy.own_truth import (
    REPORTED,
    Measured,
    OwnTruth,
    Reading,
    comparable,
    evaluate_lengths,
)
from cucumbervision.accuracy.truth import Truth, read_truth
from cucumbervision.methods.result import LengthDefinition
from cucumbervision.methods.table import AVAILABLE
from cucumbervision_greenhouse import resources, round_view
from cucumbervision_greenhouse.language import decimal_words, number_words, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import calibrations, page_elements
from cucumbervision_greenhouse.pages.page_elements import component
from cucumbervision_greenhouse.pages.round_choice import of_round
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.settings import Units, replace_text, truth_folder
from cucumbervision_greenhouse.store.records import CaptureRecord, FruitRow, StopRecord, Verdict
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.words import LENGTH_NAMES, length_words, position_words

_LINES = 30


@of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    fruit = [view for view in walk.fruit if view.length_m is not None]
    own_fruit, grid, saved = st.tabs([_("Own fruit"), _("Printed grid"), _("Calibrations")])
    with own_fruit:
        _own_fruit(walk.key, fruit)
    with grid:
        calibrations.draw_grid(walk.key)
    with saved:
        calibrations.draw_choice()


def _own_fruit(round_key: str, fruit: list[FruitRow]) -> None:
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
    path = hand_file(resources.where(), round_key)
    _table(fruit, path)
    if path.exists():
        _scores(round_key, path)


def _table(fruit: list[FruitRow], path: Path) -> None:
    units = resources.settings().units
    saved = hand_lengths(path, fruit)
    page_fruit = page_elements.first_of(fruit, "hand_page", _LINES)
    kind = page_elements.choose(
        st.segmented_control,
        _("Measured by hand"),
        {kind: _(words) for kind, words in LENGTH_NAMES.items()},
        default=LengthDefinition.CENTRELINE,
        required=True,
        help=_("Thread: laid over the outer side, from end to end. Chord: with calipers."),
    )
    st.caption(_("Lengths in {unit}.").format(unit=units.name))
    name = f"hand_{path.stem}_{units.name}"
    typed: dict[str, list[str | None]] = st.session_state.setdefault(f"{name}_typed", {})
    key = f"{name}_{page_fruit[0].key}"
    lines = [_line(view, saved.get(view.key, (None, None))) for view in page_fruit]
    data = {"lines": lines, "typed": typed, "least": LENGTHS[0], "most": LENGTHS[1]}
    send = lambda: typed.update(st.session_state[key].typed or {})  # noqa: E731
    component("handlist")(key=key, data=data, default={"typed": {}}, on_typed_change=send)
    page_elements.draw_more(fruit, "hand_page", _LINES)
    bad = _read(typed, saved)
    if bad:
        words = _("{typed}: no length between {least} and {most}.")
        words = words.format(typed=", ".join(bad), least=LENGTHS[0], most=LENGTHS[1])
        st.warning(plain(words), icon=":material/error:")
    slip = _("{by_hand} by hand, {length} by the program")
    odd = [
        slip.format(by_hand=units.text(hand_m), length=length_words(view, units))
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
        "picture": round_view.thumbnail_of(view),
        "saved": ["" if x is None else decimal_words(f"{units.value(x):.5g}") for x in saved_m],
        "program": length_words(view, units),
        "name": _("fruit {number}, {place}").format(
            number=view.fruit, place=position or view.capture
        ),
        "at": position,
        "row": view.row or "?",
    }


def _scores(round_key: str, path: Path) -> None:
    measured = measured_round(resources.store(), round_key)
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


def bias_words(own_truth: OwnTruth, units: Units) -> str:
    """Return how far the reported lengths are from those by hand, in a sentence.

    Only lengths of the definition that was measured by hand count.
    """
    pairs = [
        (length, reading.lengths_m.get(REPORTED))
        for length, reading in own_truth.pairs
        if comparable(REPORTED, length.kind, reading.kind)
    ]
    errors_m = [measured_m - length.length_m for length, measured_m in pairs if measured_m]
    if not errors_m:
        return _("None of these fruit has a length of the kind that was measured by hand.")
    mean_m, off_m = fmean(errors_m), fmean(map(abs, errors_m))
    over, below = _("{mean} too long on average"), _("{mean} too short on average")
    return _("{n} fruit: measured {error}; a single fruit is {off} off.").format(
        n=len(errors_m),
        error=(over if mean_m > 0 else below).format(mean=units.text(abs(mean_m))),
        off=units.text(off_m),
    )


def _methods(own_truth: OwnTruth) -> None:
    lines = [
        {
            _("Method"): score.method,
            _("Against"): _(LENGTH_NAMES[score.kind]),
            _("Fruit"): score.fruit,
            _("Mean absolute error"): f"{number_words(score.mape_percent, 1)} %",
            "95 %": _("needs 3 fruit")
            if score.low_percent != score.low_percent
            else _("{low} to {high}").format(
                low=number_words(score.low_percent, 1),
                high=f"{number_words(score.high_percent, 1)} %",
            ),
            _("Measured"): f"{100 * score.measured:.0f} %",
        }
        for score in own_truth.scores
    ]
    page_elements.table(lines)
    if any(score.measured < 1 for score in own_truth.scores):
        st.caption(_("A fruit that a method did not measure counts as an error of 100 %."))
    for note in own_truth.notes:
        st.caption(plain(note))


_SLIP = 2.0  # ratio to the program's length from which a length by hand is questioned
COLUMNS = ("capture", "fruit", "specimen", "length_1_cm", "length_2_cm", "kind")
LENGTHS = 0.5, 100.0
"""Shortest and longest length that can be typed, in the unit of the page."""


def hand_file(store: str, round_key: str) -> Path:
    """Return the path of a round's lengths by hand.

    Examples
    --------
    >>> hand_file("house.db", "a").parts
    ('house.truth', 'a.csv')
    """
    return truth_folder(store) / f"{round_key}.csv"


def capture_name(view: FruitRow) -> str:
    """Return a capture's name, unique within a round."""
    return f"{view.stop_key}/{view.capture}"


def measured_round(store: Store, round_key: str) -> Measured:
    """Return a round as a run of `measure`, for evaluation and calibration.

    Parameters
    ----------
    store : Store
        Where it is.
    round_key : str
        The round.

    Returns
    -------
    Measured
        Every detection that nobody deleted a reading, captures named after stop and capture; its
        report names the cameras, as calibration asks for.
    """
    content = read_round(store, round_key)
    fruit = [view for view in content.views if view.verdict is not Verdict.REJECTED]
    table = {line.key: line for line in fruit_table(content)}
    stops = [x for x in content.stops if any(view.stop_key == x.key for view in fruit)]
    captures = [_capture_lines(stop, capture) for stop in stops for capture in stop.captures]
    codes = {part.sha256 for stop in stops for part in stop.artifacts if part.kind == "software"}
    used = stops[-1].artifacts if stops else ()
    models = [{"name": x.name, "sha256": x.sha256} for x in used if x.kind == "model"]
    report: dict[str, Any] = {"captures": captures, "models": models}
    report["code_sha256"] = codes.pop() if len(codes) == 1 else ""
    for artifact in used:
        if artifact.kind in ("config", "calibration"):
            report[artifact.kind] = dict(artifact.details)
            report[f"{artifact.kind}_sha256"] = artifact.sha256
        elif artifact.kind == "software":
            report["software"] = artifact.name
    asked = [n for n in AVAILABLE if n in report.get("config", {}).get("methods", [])]
    readings = tuple(_reading(view, table.get(view.key, view), asked) for view in fruit)
    names = tuple(capture["name"] for capture in captures)
    return Measured(Path(f"round {round_key}"), readings, names, report)


def _capture_lines(stop: StopRecord, capture: CaptureRecord) -> dict[str, Any]:
    in_px = {"fx", "fy", "cx", "cy"}
    return {
        "name": f"{stop.key}/{capture.name}",
        "intrinsics": {f"{k}_px" if k in in_px else k: x for k, x in capture.camera.items()},
        "provenance": dict(capture.provenance),
        "simulated": capture.simulated,
        "fruit": [],
    }


def _reading(view: FruitRow, reported: FruitRow, asked: Sequence[str]) -> Reading:
    """Return a find as a reading; what is reported is what all views of the fruit say."""
    measured = {n: x for n in AVAILABLE if (x := getattr(view, f"{n.lower()}_m")) is not None}
    # A method that fell back on a simpler one has its length.
    fell_back = {n for n, x in measured.items() if x in [measured[m] for m in measured if m < n]}
    if view.thread_m is not None:
        measured |= {"M6 thread": view.thread_m, "M6 chord": view.chord_m}
    return Reading(
        capture=capture_name(view),
        fruit=view.fruit,
        lengths_m={**dict.fromkeys(asked), **measured, REPORTED: reported.length_m},
        fell_back=frozenset(fell_back),
        kind="" if view.length is None else str(view.length.kind),
        mask_source=view.mask_source or "",
        flags=view.flags,
    )


def write_hand_lengths(
    path: Path,
    fruit: Sequence[FruitRow],
    lengths: Mapping[str, tuple[float | None, float | None]],
    kind: LengthDefinition,
) -> int:
    """Write lengths by hand as the table that `accuracy.truth.read_truth` reads.

    Lines of other fruit, such as one that was deleted by mistake, stay in it.

    Parameters
    ----------
    path : Path
        The table; replaced in one step.
    fruit : sequence of FruitRow
        The fruit that could be measured by hand.
    lengths : mapping of str to tuple of float
        By fruit key: the first and second measurement in metres, or None.
    kind : LengthDefinition
        What was measured by hand.

    Returns
    -------
    int
        How many fruit have a length.
    """
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(COLUMNS)
    places = {(capture_name(view), view.fruit) for view in fruit}
    written = [
        (x.capture, x.fruit, x.specimen, *_cells(x.lengths_m), x.kind)
        for x in (read_truth(path).lengths if path.exists() else ())
        if (x.capture, x.fruit) not in places
    ]
    for view in fruit:
        lengths_m = lengths.get(view.key, ())
        if any(lengths_m):
            place = capture_name(view), view.fruit, view.group
            written.append((*place, *_cells(lengths_m), kind))
    table.writerows(written)
    replace_text(path, text.getvalue())
    return len(written)


def _cells(lengths_m: Sequence[float | None]) -> list[str]:
    return ["" if x is None else f"{100 * x:.2f}" for x in (*lengths_m, None)[:2]]


def truth_of(path: Path, measured: Measured) -> Truth:
    """Return the table's lengths of fruit that are measured; others were deleted since.

    Raises
    ------
    TruthError
        If the table is none.
    """
    truth, there = read_truth(path), {(r.capture, r.fruit) for r in measured.readings}
    lengths = tuple(x for x in truth.lengths if (x.capture, x.fruit) in there)
    return replace(truth, lengths=lengths)


def is_odd(record: FruitRow, hand_m: float | None) -> bool:
    """Tell whether a length by hand differs so much that it may be a slip: twice, or half.

    Examples
    --------
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> fruit = FruitRow(1, length=Length(0.25))
    >>> is_odd(fruit, 0.26), is_odd(fruit, 0.75), is_odd(fruit, 0.10), is_odd(fruit, None)
    (False, True, True, False)
    """
    if hand_m is None or record.length_m is None:
        return False
    ratio = hand_m / record.length_m
    return ratio < 1 / _SLIP or (ratio > _SLIP and not record.at_least)


def hand_lengths(
    path: Path, fruit: Sequence[FruitRow]
) -> dict[str, tuple[float | None, float | None]]:
    """Return the table by fruit key; empty where there is none.

    Raises
    ------
    TruthError
        If the table was changed, and is none any more.
    """
    if not path.exists():
        return {}
    keys = {(capture_name(view), view.fruit): view.key for view in fruit}
    lengths: dict[str, tuple[float | None, float | None]] = {}
    for line in read_truth(path).lengths:
        if key := keys.get((line.capture, line.fruit or 0)):
            first, second, *_ = (*line.lengths_m, None)
            lengths[key] = first, second
    return lengths


def typed_m(cell: str, units: Units) -> float | None:
    """Return a length as somebody typed it, metres; None for an empty cell.

    Raises
    ------
    ValueError
        If it is none, or far from any fruit's.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> typed_m("21.5", Units("cm")), typed_m(" 21,5 ", Units("cm")), typed_m("", Units("cm"))
    (0.215, 0.215, None)
    """
    if not cell.strip():
        return None
    value = float(cell.strip().replace(",", "."))
    if not LENGTHS[0] <= value <= LENGTHS[1]:
        raise ValueError(cell)
    return units.metres(value)
