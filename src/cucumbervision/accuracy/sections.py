"""What the report says about each part of the benchmark: which tables, which plots, which words."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cucumbervision.accuracy import plots
from cucumbervision.accuracy.groups import (
    coverage_rows,
    coverage_table,
    factors_of,
    group_table,
)
from cucumbervision.accuracy.records import Masks, Record, Suite
from cucumbervision.accuracy.statistics import score
from cucumbervision.accuracy.table import Cell, Column, Table
from cucumbervision.accuracy.tables import (
    Truth,
    accuracy_table,
    comparison_table,
    method_rows,
    readings,
    truth_m,
    validation_table,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["GLOSSARY", "Picture", "Section", "glance_table", "record_sections"]

SUITE_WORDS = {
    Suite.PAPER: "The paper's protocol",
    Suite.VALIDATION: "The five validation fruit",
    Suite.STRESS: "The stress set",
    Suite.OWN: "Your own fruit",
}
MASK_WORDS = {
    Masks.EXACT: "exact outlines",
    Masks.DISTURBED: "outlines disturbed by 1.5 px",
    Masks.PERCEIVED: "outlines found by a network",
}
_SUITE_INTRO = {
    Suite.PAPER: (
        "The paper's plan, simulated: 48 captures of seven cucumbers in three sizes, every method "
        "on the same captures. The camera and its noise are simulated, so the true length is known "
        "exactly."
    ),
    Suite.VALIDATION: (
        "Five more fruit with the thread lengths of the paper's validation table, simulated."
    ),
    Suite.STRESS: (
        "Simulated fruit beyond the paper: tilted, bent, partly hidden, near and far, in sun and "
        "with wet leaves. Each is another fruit."
    ),
    Suite.OWN: "Fruit measured by hand, held against what this program read from their captures.",
}
TRACKED_CAPTURES = 120  # beyond, one cannot tell captures apart
GROUPED_CAPTURES = 10  # fewer are shown one by one, and neither tested nor grouped
GLOSSARY = (
    ("centreline", "Length of the fruit's central axis, from the stem's attachment to the tip."),
    (
        "thread",
        "Length of a thread laid along the outer side of the bend from end to end, over the round "
        "ends: what people measure by hand, and the paper's ground truth. It is 5 to over 15 % "
        "more than the centreline, so a method can be right about one and wrong about the other.",
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
    (
        "skan, PlantCV, rectangle",
        "Other people's tools on the same mask and depth: the longest path and the longest segment "
        "of the mask's skeleton, lifted into space, and the long side of its smallest rectangle.",
    ),
    (
        "oracle",
        "Not a method: it knows the true tube and errs only by what the outline says about the two "
        "ends. Nobody can be expected to do better on the same masks.",
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


@dataclass(frozen=True)
class Picture:
    """A plot with what it shows.

    Parameters
    ----------
    caption : str
        In plain words.
    png : bytes
        The plot.
    """

    caption: str
    png: bytes


@dataclass(frozen=True)
class Section:
    """One part of the report.

    Parameters
    ----------
    title : str
        Its head.
    intro : tuple of str
        Paragraphs before the tables.
    entries : tuple of Table or Picture
        In order.
    """

    title: str
    intro: tuple[str, ...] = ()
    entries: tuple[Table | Picture, ...] = field(default=())


def record_sections(records: Sequence[Record], level: float = 0.9) -> list[Section]:
    """Make a section of each suite and kind of masks that has records.

    Parameters
    ----------
    records : sequence of Record
        Of any suites and masks.
    level : float
        Level that the records' intervals state.
    """
    sections = []
    for suite, masks, chosen in _parts(records):
        intro = [_SUITE_INTRO[suite]]
        fruit = len({r.fruit for r in chosen})
        intro.append(f"{len(chosen)} measurements of {fruit} fruit{_masks_words(suite, masks)}.")
        entries = [*_accuracy(chosen), *_fruit_by_fruit(chosen, suite)]
        entries += _pictures(chosen, suite)
        if len(chosen) >= GROUPED_CAPTURES:
            entries += _groups(chosen, suite)
            entries += _coverage(chosen, level)
        title = SUITE_WORDS[suite]
        title += "" if suite is Suite.OWN else f", {MASK_WORDS[masks]}"
        sections.append(Section(title, tuple(intro), tuple(entries)))
    return sections


def glance_table(records: Sequence[Record]) -> Table:
    """Sum the suites up: M6 beside the oracle and the paper's M5."""
    columns = (
        Column("part"),
        Column("outlines"),
        Column("measurements"),
        Column("fruit"),
        Column("M6 centreline MAPE (%)"),
        Column("worst (%)", 1),
        Column("measured (%)", 1),
        Column("oracle MAPE (%)"),
        Column("M6 thread MAPE (%)"),
        Column("M5 against centreline, MAPE (%)"),
        Column("M5 against thread, MAPE (%)"),
    )
    rows: list[tuple[Cell, ...]] = []
    for suite, masks, chosen in _parts(records):
        read = readings(chosen, "M6", Truth.CENTRELINE)
        tube = score(read.lengths_m, read.truth_m) if read.fruit else None
        rows.append(
            (
                SUITE_WORDS[suite],
                "–" if suite is Suite.OWN else MASK_WORDS[masks],
                len(chosen),
                len({r.fruit for r in chosen}),
                tube.mape_percent if tube else None,
                tube.worst_percent if tube else None,
                100 * tube.measured if tube else None,
                _mape(chosen, "oracle", Truth.CENTRELINE),
                _mape(chosen, "M6 thread", Truth.THREAD),
                _mape(chosen, "M5", Truth.CENTRELINE),
                _mape(chosen, "M5", Truth.THREAD),
            )
        )
    comment = "Mean error in percent of the true length; a fruit not measured counts as 100 %."
    return Table("At a glance", columns, tuple(rows), comment)


def _parts(records: Sequence[Record]) -> list[tuple[Suite, Masks, list[Record]]]:
    parts = [
        (suite, masks, [r for r in records if r.suite is suite and r.masks is masks])
        for suite in Suite
        for masks in Masks
    ]
    return [part for part in parts if part[2]]


def _masks_words(suite: Suite, masks: Masks) -> str:
    return "" if suite is Suite.OWN else f", with {MASK_WORDS[masks]}"


def _mape(records: Sequence[Record], method: str, truth: Truth) -> float | None:
    percent = readings(records, method, truth).errors_percent
    return float(percent.mean()) if percent.size else None


def _truths(records: Sequence[Record]) -> list[Truth]:
    return [t for t in Truth if any(truth_m(r, t) is not None for r in records)]


def _main_truths(records: Sequence[Record], suite: Suite) -> list[Truth]:
    """Give the truths to go into detail with: the chord only where nothing else is known."""
    known = _truths(records)
    chosen: list[Truth] = [t for t in known if t is not Truth.CHORD] or known
    return chosen[:1] if suite is Suite.STRESS else chosen


def _accuracy(records: Sequence[Record]) -> list[Table | Picture]:
    entries: list[Table | Picture] = []
    for truth in _truths(records):
        entries.append(accuracy_table(method_rows(records, truth), truth))
        tested = truth is not Truth.CHORD and len(records) >= GROUPED_CAPTURES
        test = comparison_table(records, truth) if tested else None
        entries += [test] if test else []
    return entries


def _fruit_by_fruit(records: Sequence[Record], suite: Suite) -> list[Table | Picture]:
    if suite not in (Suite.VALIDATION, Suite.OWN) or len(records) > TRACKED_CAPTURES:
        return []
    titles = {
        truth: f"Fruit by fruit, against the {truth}" for truth in _main_truths(records, suite)
    }
    return [validation_table(records, truth, title) for truth, title in titles.items()]


def _pictures(records: Sequence[Record], suite: Suite) -> list[Table | Picture]:
    pictures: list[Table | Picture] = []
    if len(records) < GROUPED_CAPTURES:
        return [_tracked(records, truth) for truth in _main_truths(records, suite)]
    for truth in _main_truths(records, suite):
        caption = f"Measured against true {truth}; on the line, both are the same."
        pictures.append(Picture(caption, plots.predicted_against_truth(records, truth)))
        if len(records) <= TRACKED_CAPTURES:
            pictures.append(_tracked(records, truth))
        caption = (
            f"Absolute errors against the {truth}: the box holds the middle half, the whiskers 90 "
            "of 100, the black bar is the median, each dot a capture."
        )
        pictures.append(Picture(caption, plots.error_spread(records, truth)))
    if suite is Suite.STRESS:
        truth = _main_truths(records, suite)[0]
        caption = "Mean error by the fruit's tilt; each step up the scale is ten times the error."
        pictures.append(Picture(caption, plots.error_against_tilt(records, truth)))
        caption = "Mean error by how much of the fruit is hidden; the same scale."
        pictures.append(Picture(caption, plots.error_against_hidden(records, truth)))
    return pictures


def _tracked(records: Sequence[Record], truth: Truth) -> Picture:
    caption = f"Capture by capture: the black steps are the true {truth}."
    return Picture(caption, plots.tracking(records, truth))


def _groups(records: Sequence[Record], suite: Suite) -> list[Table | Picture]:
    found = [
        group_table(records, factor, truth)
        for truth in _main_truths(records, suite)
        for factor in factors_of(records)
    ]
    return [table for table in found if table]


def _coverage(records: Sequence[Record], level: float) -> list[Table | Picture]:
    entries: list[Table | Picture] = []
    for truth in Truth:
        rows = coverage_rows(records, level, truth)
        if not rows:
            continue
        caption = (
            f"How often the {100 * level:.0f} % interval holds the true {truth}, by group; the bar "
            "is what chance allows (95 %). Blue: as stated. Orange diamonds: not."
        )
        title = f"How often the interval holds the true {truth}"
        entries.append(coverage_table(rows, level, title))
        entries.append(Picture(caption, plots.coverage_by_group(rows, level)))
    return entries
