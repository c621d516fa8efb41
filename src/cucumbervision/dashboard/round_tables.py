"""A round as the pages show it: its fruit with their grades, statistics, and lines in words."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cucumbervision.agronomy.grades import Verdict as GradeVerdict
from cucumbervision.agronomy.picking import hours_words
from cucumbervision.measurement.result import flag_remarks
from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.rounds.forecasting import grade_of
from cucumbervision.rounds.fruit_table import hanging_lengths_m, round_figures

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cucumbervision.agronomy.grades import Grade
    from cucumbervision.agronomy.picking import Span
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.capture.frames import Stop
    from cucumbervision.dashboard.settings import Units
    from cucumbervision.rounds.from_store import RoundContent
    from cucumbervision.rounds.fruit_table import RoundFigures, RoundFruit
    from cucumbervision.rounds.row_fruit import CountEstimate
    from cucumbervision.store.records import DetectionRecord, MethodRecord
    from cucumbervision.store.views import DetectionView, StopView


_DOUBT = 0.45  # confidence under which a fruit that is seen once may be none


@dataclass(frozen=True, eq=False)
class RoundLists:
    """A round as the pages show it.

    Parameters
    ----------
    fruit : tuple of DetectionView
        Each fruit once: the view that stands, with the length that all views give together.
    deleted : tuple of DetectionView
        Those that somebody deleted; no figure counts them.
    grades : dict of str to Grade
        By fruit key, of both.
    figures : RoundFigures
        Numbers of fruit and their lengths.
    """

    fruit: tuple[DetectionView, ...]
    deleted: tuple[DetectionView, ...]
    grades: Mapping[str, Grade]
    figures: RoundFigures


def list_round(
    content: RoundContent, table: Sequence[RoundFruit], profile: CropProfile
) -> RoundLists:
    """Return a round's fruit with their grades; `table` has its lengths."""
    standing = {line.view.key: line.view for line in table}
    best = [view for view in content.views if view.best]
    fruit = tuple(standing[view.key] for view in best if view.key in standing)
    deleted = tuple(view for view in best if view.key not in standing)
    grades = {view.key: grade_of(view.record, profile) for view in (*fruit, *deleted)}
    return RoundLists(fruit, deleted, grades, round_figures(content, table))


def doubtful(views: Iterable[DetectionView]) -> list[DetectionView]:
    """Return the fruit that one view alone shows, unsurely, and nobody has looked at."""
    return [
        view
        for view in views
        if view.views == 1 and view.verdict is None and view.record.score < _DOUBT
    ]


def grade_name(grade: Grade) -> str:
    """Return a grade in a word or two: 'class I', 'out of grade', 'not graded'.

    Examples
    --------
    >>> from cucumbervision.agronomy.grades import GradingTraits, grade
    >>> from cucumbervision.agronomy.profiles import load_profile
    >>> grade_name(grade(GradingTraits(centreline_m=0.26), load_profile("long-cucumber")))
    'class I'
    """
    if grade.verdict in (GradeVerdict.REFUSED, GradeVerdict.MISSING):
        return "not graded"
    return grade.name if grade.name == "out of grade" else f"class {grade.name}"


def length_words(record: DetectionRecord, units: Units) -> str:
    """Return a length as people say it: a lower bound as such, and 'not measured' for none.

    Examples
    --------
    >>> from cucumbervision.dashboard.settings import Units
    >>> from cucumbervision.store.records import DetectionRecord
    >>> length_words(DetectionRecord(1, length_m=0.241, flags="end-hidden"), Units("cm"))
    'at least 24.1 cm'
    """
    if record.length_m is None:
        return "not measured"
    return ("at least " if record.partial else "") + units.text(record.length_m)


def interval_words(record: DetectionRecord, units: Units) -> str | None:
    """Return a length's interval from end to end; None where it has none.

    Examples
    --------
    >>> from cucumbervision.dashboard.settings import Units
    >>> from cucumbervision.store.records import DetectionRecord
    >>> record = DetectionRecord(1, interval_low_m=0.235, interval_high_m=0.247)
    >>> interval_words(record, Units("cm"))
    '23.5 cm to 24.7 cm'
    """
    if not (record.interval_low_m and record.interval_high_m):
        return None
    return f"{units.text(record.interval_low_m)} to {units.text(record.interval_high_m)}"


def counted(number: int, one: str, many: str) -> str:
    """Return a number with its word.

    Examples
    --------
    >>> counted(1, "stop", "stops"), counted(2, "stop", "stops")
    ('1 stop', '2 stops')
    """
    return f"{number} {one if number == 1 else many}"


def round_day(at_s: float) -> str:
    """Return a moment as the day and time of this place.

    Examples
    --------
    >>> len(round_day(1_700_000_000.0))
    17
    """
    return time.strftime("%d %b %Y %H:%M", time.localtime(at_s))


def remarks(record: DetectionRecord, units: Units) -> str:
    """Return what else to know of a fruit, as short sentences; what only we need is left out.

    Examples
    --------
    >>> from cucumbervision.dashboard.settings import Units
    >>> from cucumbervision.store.records import DetectionRecord
    >>> fruit = DetectionRecord(1, length_m=0.24, flags="keypoints-logged end-hidden")
    >>> remarks(fruit, Units("cm"))
    'an end is hidden: at least 24.0 cm'
    """
    is_bound = record.partial and record.length_m is not None
    return flag_remarks(record.flags, length_words(record, units) if is_bound else "")


def stop_name(stop: Stop | StopView) -> str:
    """Return where a stop is, for people.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> stop_name(Stop("3", "left", 1.2, 4))
    'Stop 4: row 3, left, 1.20 m'
    """
    at = "" if stop.position_m is None else f"{stop.position_m:.2f} m"
    where = ", ".join(filter(None, (stop.row and f"row {stop.row}", stop.side, at)))
    return f"{step_words(stop.step)}: {where or 'no place given'}"


def step_words(step: int | None) -> str:
    """Return a stop's number, for people.

    Examples
    --------
    >>> step_words(0), step_words(None)
    ('Stop 0', 'Stop')
    """
    return "Stop" if step is None else f"Stop {step}"


def figure_lines(record: DetectionRecord) -> list[dict[str, str]]:
    """Return a line for every figure that the store keeps of a fruit: what it is, and its value.

    Examples
    --------
    >>> from cucumbervision.store.records import DetectionRecord
    >>> figure_lines(DetectionRecord(1, diameter_max_m=0.0412))[-1]
    {'What': 'Largest diameter', 'Value': '41.2 mm'}
    """
    lines = []
    for one in FIELDS:
        cell = one.cell(getattr(record, one.si_name, None), one.digits)
        if one.type == "number" and cell is not None and not one.name.startswith("box_"):
            value = f"{cell:g} {one.unit}".strip()
            lines.append({"What": one.says[0].upper() + one.says[1:], "Value": value})
    return lines


def length_lines(
    fruit: Sequence[DetectionView], grades: Mapping[str, Grade], units: Units
) -> list[dict[str, Any]]:
    """Return a line for each measured fruit on the plant for the histogram: length and class."""
    return [
        {"length": units.value(view.record.length_m), "class": grade_name(grades[view.key])}
        for view in fruit
        if hanging_lengths_m([view])
    ]


def method_lines(
    by_fruit: Mapping[str, Sequence[MethodRecord]], keys: set[str], units: Units
) -> list[dict[str, Any]]:
    """Return a line for each method's own length of each fruit, by fruit key."""
    return [
        {"method": method.method, "length": units.value(method.length_m)}
        for key, methods in by_fruit.items()
        if key in keys
        for method in methods
        if method.length_m is not None and method.measured_by is None
    ]


def row_name(row: str | None) -> str:
    """Return what a row is called in a sentence.

    Examples
    --------
    >>> row_name("3"), row_name("")
    ('Row 3', 'Row ?')
    """
    return f"Row {row or '?'}"


def count_words(count: CountEstimate) -> str:
    """Return how many fruit a row has, with its interval, and how many were found.

    Examples
    --------
    >>> from cucumbervision.rounds.row_fruit import CountEstimate
    >>> count_words(CountEstimate.of_nothing())
    'no fruit found'
    """
    if not len(count.seen):
        return "no fruit found"
    low, high = count.interval()
    there = f"{low} to {high}" if low < high else f"{low}"
    found = counted(len(count.seen), "was", "were")
    return f"{count.expected:.0f} fruit ({there}, 90 %), of which {found} found"


def map_lines(lists: RoundLists, units: Units) -> list[dict[str, Any]]:
    """Return a line for each fruit with a position: along the row, height, class, length."""
    return [
        {
            "key": view.key,
            "row": row_name(view.row) + (f", {view.side}" if view.side else ""),
            "along": round(view.along_m, 2),
            "height": -round(view.record.centre_y_m or 0.0, 3),
            "length": units.value(view.record.length_m),
            "class": grade_name(lists.grades[view.key]),
            "views": view.views,
            "mark": _mark_of(view),
            "capture": view.capture,
        }
        for view in lists.fruit
        if view.along_m is not None
    ]


def _mark_of(view: DetectionView) -> str:
    if view.simulated:
        return "drawn"
    return "seen" if view.picked_s is None else "picked"


def span_words(of: Span) -> str:
    """Return a number of fruit with its interval, both whole.

    Examples
    --------
    >>> from cucumbervision.agronomy.picking import Span
    >>> span_words(Span(3.8, 3.0, 5.0)), span_words(Span(0.2, 0.0, 1.0)), span_words(Span(0, 0, 0))
    ('4 (3 to 5)', '0 to 1', '–')
    """
    if of.high < 0.5:
        return "–"
    if of.expected < 0.5:
        return f"0 to {of.high:.0f}"
    words = f"{of.expected:.0f}"
    return words if of.low == of.high else f"{words} ({of.low:.0f} to {of.high:.0f})"


def hours_span_words(of: Span) -> str:
    """Return hours of work with their interval, as `hours_words` says each.

    Examples
    --------
    >>> from cucumbervision.agronomy.picking import Span
    >>> hours_span_words(Span(0.31, 0.2, 0.5)), hours_span_words(Span(3.24, 2.9, 4.0))
    ('19 min (12 min to 30 min)', '3.2 h (2.9 h to 4.0 h)')
    """
    low, at, high = map(hours_words, (of.low, of.expected, of.high))
    return at if low == high else f"{at} ({low} to {high})"
