"""Accuracy: lengths measured by hand beside the program's, and a calibration from them."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.accuracy.measured import REPORTED, Measured, Reading
from cucumbervision.accuracy.own_truth import OwnTruth, evaluate_lengths
from cucumbervision.accuracy.truth import read_truth
from cucumbervision.calibration.calibration_file import write_site_calibration
from cucumbervision.calibration.site_calibration import calibrate_lengths
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_greenhouse.backend import resources, round_caches
from cucumbervision_greenhouse.backend.settings import replace_text
from cucumbervision_greenhouse.backend.words import length_words, metres_words, plain
from cucumbervision_greenhouse.dashboard import page_elements
from cucumbervision_greenhouse.dashboard.page_elements import component
from cucumbervision_greenhouse.rounds.from_store import read_round
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table
from cucumbervision_greenhouse.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision_greenhouse.backend.settings import Units
    from cucumbervision_greenhouse.store.records import DetectionRecord, MethodRecord
    from cucumbervision_greenhouse.store.repository import Store
    from cucumbervision_greenhouse.store.views import DetectionSummary, RoundSummary

_SLIP = 2.0  # ratio to the program's length from which a length by hand is questioned
COLUMNS = ("capture", "fruit", "specimen", "length_1_cm", "length_2_cm", "kind")


def hand_file(store: str, round_key: str) -> Path:
    """Return the path of a round's lengths by hand: beside an SQLite file, else the user's own.

    Examples
    --------
    >>> hand_file("house.db", "a").parts
    ('house.truth', 'a.csv')
    """
    if "://" in store:
        import platformdirs

        folder = Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "truth"
    else:
        folder = Path(store).with_suffix(".truth")
    return folder / f"{round_key}.csv"


def capture_name(view: DetectionSummary) -> str:
    """Return a capture's name, unique within a round."""
    return f"{view.stop_key}/{view.capture}"


def measured_round(
    store: Store, round_key: str, methods: Mapping[str, Sequence[MethodRecord]]
) -> Measured:
    """Return a round as a run of `measure`, for evaluation and calibration.

    Parameters
    ----------
    store : Store
        Where it is.
    round_key : str
        The round.
    methods : mapping of str to sequence of MethodRecord
        By fruit key, as `Store.measurements` gives them.

    Returns
    -------
    Measured
        Every detection that nobody deleted a reading, captures named after stop and capture; its
        report names the cameras, as calibration asks for.
    """
    fruit = [v for v in store.detections(round_key) if v.verdict is not Verdict.REJECTED]
    table = {line.view.key: line.view for line in fruit_table(read_round(store, round_key))}
    readings = tuple(
        _reading(view, table.get(view.key, view), methods.get(view.key, ())) for view in fruit
    )
    captures: list[dict[str, Any]] = []
    report: dict[str, Any] = {"captures": captures}
    for key in dict.fromkeys(view.stop_key for view in fruit):
        stop = store.stop(key)
        for capture in stop.captures:
            camera = dict(capture.camera)
            for name in ("fx", "fy", "cx", "cy"):
                camera[f"{name}_px"] = camera.pop(name)
            captures.append(
                {
                    "name": f"{key}/{capture.name}",
                    "intrinsics": camera,
                    "provenance": dict(capture.provenance),
                    "simulated": capture.simulated,
                    "fruit": [],
                }
            )
        report.update(_made_with(stop.artifacts))
    names = tuple(capture["name"] for capture in captures)
    return Measured(Path(f"round {round_key}"), readings, names, report)


def _made_with(artifacts: Sequence[Any]) -> dict[str, Any]:
    made_with: dict[str, Any] = {"models": []}
    for artifact in artifacts:
        if artifact.kind == "config":
            made_with |= {"config": dict(artifact.details), "config_sha256": artifact.sha256}
        elif artifact.kind == "software":
            made_with["software"] = artifact.name
        elif artifact.kind == "model":
            made_with["models"].append({"name": artifact.name, "sha256": artifact.sha256})
        elif artifact.kind == "calibration":
            made_with["calibration"] = dict(artifact.details)
    return made_with


def _reading(
    view: DetectionSummary, reported: DetectionSummary, methods: Sequence[MethodRecord]
) -> Reading:
    """Return a find as a reading; what is reported is what all views of the fruit say."""
    record = view.record
    lengths = {method.method: method.length_m for method in methods}
    tube = next((method for method in methods if method.thread_m is not None), None)
    if tube is not None:
        lengths |= {"M6 thread": tube.thread_m, "M6 chord": tube.chord_m}
    return Reading(
        capture=capture_name(view),
        fruit=record.number,
        lengths_m={**lengths, REPORTED: reported.record.length_m},
        fell_back=frozenset(method.method for method in methods if method.measured_by),
        kind="" if record.length is None else str(record.length.kind),
        method=record.method or "",
        mask_source=record.mask_source or "",
        distance_m=_or_nan(record.distance_m),
        fill=_or_nan(record.fill),
        flags=record.flags,
    )


def write_hand_lengths(
    path: Path,
    fruit: Sequence[DetectionSummary],
    lengths: Mapping[str, tuple[float | None, float | None]],
    kind: LengthDefinition,
) -> int:
    """Write lengths by hand as the table that `accuracy.truth.read_truth` reads.

    Parameters
    ----------
    path : Path
        The table; replaced in one step.
    fruit : sequence of DetectionSummary
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
    written = 0
    for view in fruit:
        first, second = lengths.get(view.key, (None, None))
        if first is None and second is None:
            continue
        cells = ["" if x is None else f"{100 * x:.2f}" for x in (first, second)]
        table.writerow([capture_name(view), view.record.number, view.group, *cells, str(kind)])
        written += 1
    replace_text(path, text.getvalue())
    return written


def is_odd(record: DetectionRecord, hand_m: float | None) -> bool:
    """Tell whether a length by hand differs so much that it may be a slip: twice, or half.

    Examples
    --------
    >>> from cucumbervision.measurement.result import Length
    >>> from cucumbervision_greenhouse.store.records import DetectionRecord
    >>> fruit = DetectionRecord(1, length=Length(0.25))
    >>> is_odd(fruit, 0.26), is_odd(fruit, 0.75), is_odd(fruit, 0.10), is_odd(fruit, None)
    (False, True, True, False)
    """
    if hand_m is None or record.length_m is None:
        return False
    ratio = hand_m / record.length_m
    return ratio < 1 / _SLIP or (ratio > _SLIP and not record.at_least)


def hand_lengths(
    path: Path, fruit: Sequence[DetectionSummary]
) -> dict[str, tuple[float | None, float | None]]:
    """Return the table by fruit key; empty where there is none."""
    if not path.exists():
        return {}
    keys = {(capture_name(view), str(view.record.number)): view.key for view in fruit}
    lengths: dict[str, tuple[float | None, float | None]] = {}
    with path.open(encoding="utf-8", newline="") as stream:
        for line in csv.DictReader(stream):
            key = keys.get((line["capture"], line["fruit"]))
            if key is not None:
                lengths[key] = (_cell_m(line["length_1_cm"]), _cell_m(line["length_2_cm"]))
    return lengths


def _cell_m(cell: str) -> float | None:
    return float(cell) / 100 if cell else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


_LINES = 30
_LENGTHS = 0.5, 100.0  # that can be typed, in the unit of the page


@page_elements.of_round
def page(round_summary: RoundSummary) -> None:
    """Draw the page."""
    graded = round_caches.graded_round(round_summary)
    fruit = [view for view in graded.fruit if view.record.length_m is not None]
    if not fruit:
        st.info("This round has no measured fruit yet.", icon=":material/straighten:")
        return
    st.write(
        "Measure some fruit by hand and enter the lengths here: the table below then gives each "
        "method's error on your fruit. Measure some of them twice, without looking at the first "
        "value: no method can be shown to be more accurate than the measurements by hand."
    )
    path = hand_file(resources.where(), round_summary.key)
    _table(fruit, path)
    if path.exists():
        _scores(round_summary, path)


def _table(fruit: list[DetectionSummary], path: Path) -> None:
    units = resources.settings().units
    saved = hand_lengths(path, fruit)
    page_elements.choose_page(fruit, "hand_page", _LINES)
    page_fruit = page_elements.page_of(fruit, "hand_page", _LINES)
    kind = st.segmented_control(
        "Measured by hand",
        list(LengthDefinition),
        format_func=lambda x: str(x).capitalize(),
        default=LengthDefinition.CENTRELINE,
        required=True,
        help="Thread: laid over the outer side, from end to end. Chord: with calipers.",
    )
    st.caption(f"Lengths in {units.name}.")
    name = f"hand_{path.stem}_{units.name}"
    typed: dict[str, list[str]] = st.session_state.setdefault(f"{name}_typed", {})
    key = f"{name}_{page_fruit[0].key}"
    component("handlist")(
        key=key,
        data={
            "lines": [_line(view, saved.get(view.key, (None, None))) for view in page_fruit],
            "typed": typed,
            "least": _LENGTHS[0],
            "most": _LENGTHS[1],
        },
        default={"typed": {}},
        on_typed_change=lambda: typed.update(st.session_state[key].typed or {}),
    )
    bad = _read(typed, saved)
    if bad:
        st.warning(
            plain(f"{', '.join(bad)}: no length between {_LENGTHS[0]} and {_LENGTHS[1]}."),
            icon=":material/error:",
        )
    odd = [
        f"{units.text(hand_m)} by hand, {length_words(view.record, units)} by the program"
        for view in fruit
        for hand_m in saved.get(view.key, ())
        if is_odd(view.record, hand_m)
    ]
    if odd:
        st.warning(f"{plain('; '.join(odd))}. Is that right?", icon=":material/help:")
        odd = [] if st.checkbox("Yes, these lengths are right", key=f"sure_{odd}") else odd
    unsure = bool(odd or bad)  # also if the button was pressed before the check
    save: dict[str, Any] = {"type": "primary", "icon": ":material/save:", "disabled": unsure}
    if st.button("Save these lengths", **save) and not unsure:
        if not write_hand_lengths(path, fruit, saved, kind or LengthDefinition.CENTRELINE):
            path.unlink()  # every length was taken out again
        typed.clear()
        st.rerun()


def _read(
    typed: Mapping[str, Sequence[str]], saved: dict[str, tuple[float | None, float | None]]
) -> list[str]:
    """Add typed values to the saved lengths; return those that are not lengths."""
    units, bad = resources.settings().units, list[str]()
    for key, cells in typed.items():
        lengths = list(saved.get(key, (None, None)))
        for index, cell in enumerate(cells[:2]):
            try:
                lengths[index] = typed_m(str(cell), units)
            except ValueError:
                bad.append(str(cell))
        saved[key] = lengths[0], lengths[1]
    return bad


def _line(view: DetectionSummary, saved_m: tuple[float | None, float | None]) -> dict[str, Any]:
    units = resources.settings().units
    position = metres_words(view.along_m) if view.along_m is not None else ""
    return {
        "key": view.key,
        "picture": round_caches.thumbnail_of(view),
        "saved": ["" if x is None else f"{units.value(x):.5g}" for x in saved_m],
        "program": units.text(view.record.length_m),
        "name": f"fruit {view.record.number}, {position or view.capture}",
        "at": position,
        "row": view.row or "?",
    }


def typed_m(cell: str, units: Units) -> float | None:
    """Return a length as somebody typed it, metres; None for an empty cell.

    Raises
    ------
    ValueError
        If it is none, or far from any fruit's.

    Examples
    --------
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> typed_m("21.5", Units("cm")), typed_m(" 21,5 ", Units("cm")), typed_m("", Units("cm"))
    (0.215, 0.215, None)
    """
    if not cell.strip():
        return None
    value = float(cell.strip().replace(",", "."))
    if not _LENGTHS[0] <= value <= _LENGTHS[1]:
        raise ValueError(cell)
    return units.metres(value)


def _scores(round_summary: RoundSummary, path: Path) -> None:
    measured = measured_round(
        resources.store(), round_summary.key, round_caches.methods_of(round_summary)
    )
    truth = read_truth(path)
    own_truth: OwnTruth = evaluate_lengths(measured, truth)
    st.subheader("Errors")
    lines = [
        {
            "Method": score.method,
            "Against": str(score.kind),
            "Fruit": score.fruit,
            "Mean absolute error": f"{score.metrics.mape_percent:.1f} %",
            "95 %": "needs 3 fruit"
            if score.low_percent != score.low_percent
            else f"{score.low_percent:.1f} to {score.high_percent:.1f} %",
            "Measured": f"{100 * score.metrics.measured:.0f} %",
        }
        for score in own_truth.scores
    ]
    page_elements.table(lines)
    if any(score.metrics.measured < 1 for score in own_truth.scores):
        st.caption("A fruit that a method did not measure counts as an error of 100 %.")
    for note in own_truth.notes:
        st.caption(plain(note))
    st.subheader("Calibrate this site")
    name = st.text_input("Name of the calibration", "my house")
    if st.button("Calibrate with these lengths", icon=":material/target:"):
        try:
            site = calibrate_lengths(measured, truth, name.strip() or "my house")
            out = path.with_name(f"{path.stem}.calibration.json")
            write_site_calibration(out, site)
        except CucumberVisionError as error:
            st.error(plain(error), icon=":material/error:")
        else:
            st.success(
                f"Written to {plain(out)}. Name it in 'Settings' to use it.",
                icon=":material/check:",
            )
