"""Accuracy: lengths measured by hand beside the program's, and a calibration from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import streamlit as st

from cucumbervision.accuracy.own_truth import OwnTruth, evaluate_lengths
from cucumbervision.accuracy.truth import read_truth
from cucumbervision.calibration.calibration_file import write_site_calibration
from cucumbervision.calibration.site_calibration import calibrate_lengths
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.hand_truth import (
    hand_file,
    hand_lengths,
    measured_round,
    write_hand_lengths,
)
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition

if TYPE_CHECKING:
    from cucumbervision.dashboard.round_tables import RoundLists
    from cucumbervision.store.views import DetectionView, RoundView

__all__ = ["page"]

LINES = 30


@page_elements.of_round
def page(one: RoundView) -> None:
    """Draw the page."""
    lists = resources.lists_of(one)
    fruit = [view for view in lists.fruit if view.record.length_m is not None]
    if not fruit:
        st.info("This round has no measured fruit yet.", icon=":material/straighten:")
        return
    st.write(
        "Measure some fruit by hand and enter the lengths here: the table below then gives each "
        "method's error on your fruit. Measure some of them twice, without looking at the first "
        "value: no method can be shown to be more accurate than the measurements by hand."
    )
    path = hand_file(resources.where(), one.key)
    _table(fruit, path)
    if path.exists():
        _scores(one, lists, path)


def _table(fruit: list[DetectionView], path: Path) -> None:
    units = resources.settings().units
    known = hand_lengths(path, fruit)
    page_elements.choose_page(fruit, "hand_page", LINES)
    shown = page_elements.page_of(fruit, "hand_page", LINES)
    kind = st.segmented_control(
        "Measured by hand",
        list(LengthDefinition),
        format_func=lambda x: str(x).capitalize(),
        default=LengthDefinition.THREAD,
        required=True,
        help="Thread: laid over the outer side, from end to end. Chord: with calipers.",
    )
    lines = [_line(view, known.get(view.key, (None, None))) for view in shown]
    edited: list[dict[str, Any]] = st.data_editor(
        lines,
        hide_index=True,
        row_height=56,
        placeholder="",
        disabled=["Picture", "Fruit", "Program"],
        column_config={
            "Picture": st.column_config.ImageColumn("", width="small"),
            "Program": st.column_config.NumberColumn(f"Program [{units.name}]", format="%.1f"),
            "First": st.column_config.NumberColumn(
                f"By hand [{units.name}]", min_value=0.5, max_value=100.0, format="%.2f"
            ),
            "Second": st.column_config.NumberColumn(
                f"Again [{units.name}]", min_value=0.5, max_value=100.0, format="%.2f"
            ),
        },
        key=f"hand_{path.stem}_{shown[0].key}",
    )
    if st.button("Save these lengths", type="primary", icon=":material/save:"):
        for view, line in zip(shown, edited, strict=True):
            known[view.key] = _metres(line["First"]), _metres(line["Second"])
        write_hand_lengths(path, fruit, known, kind or LengthDefinition.THREAD)
        st.rerun()


def _line(view: DetectionView, known: tuple[float | None, float | None]) -> dict[str, Any]:
    units = resources.settings().units
    along = "" if view.along_m is None else f", {view.along_m:.2f} m"
    return {
        "Picture": resources.thumbnail_of(view),
        "Fruit": f"Row {view.row or '?'}{along}, no. {view.record.number} of {view.capture}",
        "Program": units.value(view.record.length_m),
        "First": units.value(known[0]),
        "Second": units.value(known[1]),
    }


def _metres(value: float | None) -> float | None:
    return None if value is None else resources.settings().units.metres(float(value))


def _scores(one: RoundView, lists: RoundLists, path: Path) -> None:
    measured = measured_round(resources.store(), one.key, lists.methods)
    truth = read_truth(path)
    found: OwnTruth = evaluate_lengths(measured, truth)
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
        }
        for score in found.scores
    ]
    page_elements.table(lines)
    for note in found.notes:
        st.caption(note)
    st.subheader("Calibrate this site")
    name = st.text_input("Name of the calibration", "my house")
    if st.button("Calibrate with these lengths", icon=":material/target:"):
        try:
            site = calibrate_lengths(measured, truth, name.strip() or "my house")
            out = path.with_name(f"{path.stem}.calibration.json")
            write_site_calibration(out, site)
        except CucumberVisionError as error:
            st.error(str(error), icon=":material/error:")
        else:
            st.success(
                f"Written to {out}. Name it in 'Settings' to use it.", icon=":material/check:"
            )
