"""What a report says of one set of readings: which tables, which plots, which words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.accuracy.table import Table
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.report import plots
from cucumbervision_lab.report.length_tables import (
    accuracy_table,
    against,
    comparison_table,
    factors_of,
    fruit_table,
    group_table,
    truths_of,
)
from cucumbervision_lab.report.page import Plot, Section

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

_TRACKED_CAPTURES = 120  # beyond, one cannot tell captures apart
GROUPED_CAPTURES = 10  # fewer are shown one by one, and neither tested nor grouped
GLOSSARY = (
    (
        "centreline",
        "Length of the fruit's central axis, from the stem's attachment to the blossom end: what a "
        "tape reads, and what this program reports.",
    ),
    (
        "thread",
        "Length of the outer side of the bend, from end to end: the paper's ground truth. It is 2 "
        "to 6 % more than the centreline of a usual fruit, and the same for a straight one.",
    ),
    ("chord", "Straight from end to end, as a caliper measures."),
    (
        "M1 to M5",
        "The paper's five methods, rebuilt as it describes them: scan line, principal axis of the "
        "box, principal axis of the mask, keypoints, spline along the mask.",
    ),
    (
        "M6",
        "This program's own method: a tube with round ends, fitted to depth and outline together. "
        "It gives all three lengths ('M6' is its centreline).",
    ),
    ("MAE, RMSE", "Mean absolute error, and root mean square error, which weighs large ones more."),
    ("MAPE", "Mean absolute error in percent of the true length."),
    ("bias", "Mean signed error of the fruit measured; negative means read too short."),
    ("R², Pearson r", "How well lengths follow the truth: 1 is perfect. R² also counts a bias."),
    (
        "95 % by capture, by fruit",
        "Range of the MAPE if captures, or whole fruit, are drawn again at random (bootstrap).",
    ),
)


def reading_section(title: str, intro: Sequence[str], readings: pd.DataFrame) -> Section:
    """Return a section over readings: accuracy, fruit by fruit, plots, and groups.

    Parameters
    ----------
    title : str
        Its head.
    intro : sequence of str
        Paragraphs before the tables.
    readings : DataFrame
        As `readings_frame` gives them, of one suite and one kind of masks.
    """
    truths = main_truths(readings)
    entries = [
        *accuracy_entries(readings),
        *fruit_entries(readings, truths),
        *plot_entries(readings, truths),
        *group_entries(readings, truths),
    ]
    return Section(title, tuple(intro), tuple(entries))


def main_truths(readings: pd.DataFrame) -> list[LengthDefinition]:
    """Return the truths to go into detail with: the chord only where nothing else is known."""
    known = truths_of(readings)
    return [truth for truth in known if truth is not LengthDefinition.CHORD] or known


def accuracy_entries(readings: pd.DataFrame) -> list[Table | Plot]:
    """Return each truth's table of accuracy and, with enough captures, of comparisons."""
    entries: list[Table | Plot] = []
    for truth in truths_of(readings):
        entries.append(accuracy_table(readings, truth))
        tested = (
            truth is not LengthDefinition.CHORD and readings["case"].nunique() >= GROUPED_CAPTURES
        )
        test = comparison_table(readings, truth) if tested else None
        entries += [test] if test else []
    return entries


def fruit_entries(readings: pd.DataFrame, truths: Sequence[LengthDefinition]) -> list[Table | Plot]:
    """Return tables fruit by fruit; none where there are too many."""
    if readings["case"].nunique() > _TRACKED_CAPTURES:
        return []
    return [fruit_table(readings, truth) for truth in truths]


def plot_entries(readings: pd.DataFrame, truths: Sequence[LengthDefinition]) -> list[Table | Plot]:
    """Return the plots that suit so many captures."""
    captures = readings["case"].nunique()
    pictures: list[Table | Plot] = []
    for truth in truths:
        tracked = f"Capture by capture: the black steps are the true {truth}."
        if captures >= GROUPED_CAPTURES:
            caption = f"Measured against true {truth}; on the line, both are the same."
            pictures.append(Plot(caption, plots.predicted_against_truth(readings, truth)))
        if captures <= _TRACKED_CAPTURES:
            pictures.append(Plot(tracked, plots.tracking(readings, truth)))
        if captures >= GROUPED_CAPTURES:
            caption = (
                f"Absolute errors against the {truth}: the box holds the middle half, the whiskers "
                "90 of 100, the black bar is the median, each dot a capture."
            )
            pictures.append(Plot(caption, plots.error_spread(readings, truth)))
    return pictures


def group_entries(readings: pd.DataFrame, truths: Sequence[LengthDefinition]) -> list[Table | Plot]:
    """Return a table a factor that tells the readings apart; none for few captures."""
    if readings["case"].nunique() < GROUPED_CAPTURES:
        return []
    entries: list[Table | Plot] = []
    for truth in truths:
        scored = against(readings, truth)
        entries += [
            group_table(scored, factor, truth) for factor in factors_of(scored, scored["true_m"])
        ]
    return entries
