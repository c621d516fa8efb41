"""Words of pages for rounds, fruit and forecasts, in the language shown."""

from __future__ import annotations

import math
import time
from datetime import date, datetime
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.crop import grades
from cucumbervision.crop.grades import UNDECIDED, class_name
from cucumbervision.methods.flags import FLAGS
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_greenhouse import language
from cucumbervision_greenhouse.language import counted, marked
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.rounds.forecasting import date_after
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S
from cucumbervision_greenhouse.rounds.walking import is_demonstration

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision.capture.frames import Stop
    from cucumbervision.crop.grades import Grade
    from cucumbervision_greenhouse.forecast.forecast import Forecast
    from cucumbervision_greenhouse.forecast.growth import Growth
    from cucumbervision_greenhouse.forecast.picking import Pick, Ready, Span
    from cucumbervision_greenhouse.settings import Units
    from cucumbervision_greenhouse.store.records import FruitRow, LogEntry, Round, StopRecord


LENGTH_NAMES = {
    LengthDefinition.CENTRELINE: marked("Centreline"),
    LengthDefinition.THREAD: marked("Thread"),
    LengthDefinition.CHORD: marked("Chord"),
}
"""Names of the definitions of length."""

_DEMONSTRATION = marked("Demonstration (computer-made example)")


def position_words(along_m: float | None, units: Units) -> str:
    """Return a position along a row in words; a negative position is shown as 0.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> [position_words(1.204, Units(name)) for name in ("cm", "in")]
    ['1.20 m', '3.95 ft']
    """
    name, per_metre = units.along
    return f"{language.number_words(max(along_m or 0.0, 0.0) * per_metre, 2)} {name}"


def round_day(at_s: float) -> str:
    """Return a moment as local day and time.

    Examples
    --------
    >>> len(round_day(1_700_000_000.0))
    17
    """
    return language.moment_words(datetime.fromtimestamp(at_s))


def day_words(at_s: float) -> str:
    """Return a moment as local weekday and date.

    Examples
    --------
    >>> day_words(1_700_000_000.0)
    'Tue 14 Nov'
    """
    return language.day_month_words(date.fromtimestamp(at_s))


def date_words(day: date, today: date) -> str:
    """Return a day in words: 'today', 'tomorrow', or the weekday and date.

    Examples
    --------
    >>> [date_words(date(2023, 11, day), date(2023, 11, 14)) for day in (13, 14, 15, 16)]
    ['Mon 13 Nov', 'today', 'tomorrow', 'Thu 16 Nov']
    """
    return {0: _("today"), 1: _("tomorrow")}.get((day - today).days, language.day_month_words(day))


def round_name(round_summary: Round) -> str:
    """Return a round's name in a list: its name, house, day and number of stops."""
    house = f", {round_summary.house}" if round_summary.house else ""
    stops = counted(round_summary.stops, "stop", "stops")
    name, day = round_summary.name or marked("Round"), round_day(round_summary.walked_s)
    name = _(name) if is_demonstration(round_summary.key) or not round_summary.name else name
    return f"{name}{house} · {day} · {stops}"


_ACTIONS = {
    "accept": marked("accepted"),
    "reject": marked("not a fruit"),
    "clear": marked("no longer accepted, nor marked as no fruit"),
    "pick": marked("picked"),
    "unpick": marked("not picked"),
    "harvest": marked("the harvest"),
    "correct": marked("the new outline"),
    "add": marked("the fruit that was added"),
    "merge": marked("same fruit"),
    "unmerge": marked("different fruit"),
    "link-growth": marked("same fruit on two days"),
    "unlink-growth": marked("different fruit on two days"),
    "place-stop": marked("the stop's new place or name"),
    "delete-stop": marked("the stop was deleted"),
    "take-back-stop": marked("the last stop was taken back"),
    "rename-round": marked("the round's new name"),
    "move-round": marked("the round's new house"),
    "delete-round": marked("the round was deleted"),
}


def action_words(action: LogEntry) -> str:
    """Return an action in words.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import LogEntry
    >>> action_words(LogEntry(7, 0.0, "ana", "reject", None, ("a",)))
    'not a fruit'
    >>> action_words(LogEntry(7, 0.0, "ana", "pick", None, ("a", "b")))
    'picked (2 fruit)'
    """
    words, number = _(_ACTIONS.get(action.kind, action.kind)), len(action.fruit)
    if action.kind == "pick" and number > 1:
        return f"{words} ({counted(number, '{n} fruit', '{n} fruit')})"
    return words


def taken_back(action: LogEntry) -> str:
    """Return the words for an action that was undone.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import LogEntry
    >>> taken_back(LogEntry(7, 0.0, "ana", "reject", None, ("a",)))
    'Taken back: not a fruit'
    """
    return _("Taken back: {action}").format(action=action_words(action))


def stop_name(stop: Stop | StopRecord, units: Units) -> str:
    """Return the place of a stop in words.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> from cucumbervision_greenhouse.settings import Units
    >>> stop_name(Stop("3", "left", 1.2, 4), Units("cm"))
    'Stop 4: row 3, left, 1.20 m'
    """
    position = "" if stop.position_m is None else position_words(stop.position_m, units)
    row = _("row {row}").format(row=stop.row) if stop.row else ""
    where = ", ".join(filter(None, (row, side_words(stop.side), position)))
    return f"{step_words(stop.step)}: {where or _('no place given')}"


def side_words(side: str | None) -> str:
    """Return the side of a row for people; a name that the program does not give stays.

    Examples
    --------
    >>> side_words("left"), side_words("aisle"), side_words(None)
    ('left', 'aisle', '')
    """
    return {"left": _("left"), "right": _("right")}.get(side or "", side or "")


def step_words(step: int | None) -> str:
    """Return a stop's number in words.

    Examples
    --------
    >>> step_words(0), step_words(None)
    ('Stop 0', 'Stop')
    """
    return _("Stop") if step is None else _("Stop {number}").format(number=step)


def row_name(row: str | None) -> str:
    """Return a row's name in a sentence.

    Examples
    --------
    >>> row_name("3"), row_name("")
    ('Row 3', 'Row ?')
    """
    return _("Row {row}").format(row=row or "?")


def row_and_side(view: FruitRow) -> str:
    """Return the row and side of a fruit.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> row_and_side(FruitRow(1, row="3", side="left"))
    'Row 3, left'
    """
    return row_name(view.row) + (f", {side_words(view.side)}" if view.side else "")


def clock_words(walked_s: float) -> str:
    """Return the words for a round that is later than this machine's clock."""
    return _(
        "The last stop ({when}) is later than this computer's clock ({now}): set the clock. Until "
        "then days, growth and what is left to pick are not right."
    ).format(when=round_day(walked_s), now=round_day(time.time()))


def age_words(days: int) -> str:
    """Return the day of a measurement in words.

    Examples
    --------
    >>> age_words(0), age_words(1), age_words(4)
    ('today', 'yesterday', '4 days ago')
    """
    if days < 2:
        return _("yesterday") if days == 1 else _("today")
    return counted(days, "{n} day ago", "{n} days ago")


def pick_words(pick: Pick) -> str:
    """Return the class of a fruit on the pick list: 'class I', 'undecided: class I or too long'.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.growth import FruitState
    >>> from cucumbervision_greenhouse.forecast.picking import Pick, PickKind
    >>> fruit = FruitState("a", "1", 0.5, 0.25, 0.01)
    >>> pick_words(Pick(fruit, "I", 0.99))
    'class I'
    >>> pick_words(Pick(fruit, "undecided", 0.5, PickKind.UNDECIDED, ("II", "I")))
    'undecided: class II or I'
    """
    if pick.name != UNDECIDED:
        return class_words(pick.name)
    if pick.fruit.at_least:
        return f"{_(UNDECIDED)} ({_('only part of it is seen')})"
    return f"{_(UNDECIDED)}: {choice_words(pick.possible)}"


def class_words(name: str) -> str:
    """Return the name of a class for people, in the language that is shown.

    Examples
    --------
    >>> class_words("I"), class_words("too long")
    ('class I', 'too long')
    """
    return language.words_of(class_name(name))


def label_words(label: str) -> str:
    """Return the label of a grade in the language that is shown.

    Examples
    --------
    >>> label_words("class I"), label_words("too long")
    ('class I', 'too long')
    """
    name = label.removeprefix("class ")
    return _(label) if name == label else class_words(name)


def choice_words(names: Iterable[str]) -> str:
    """Return several classes for people.

    Examples
    --------
    >>> choice_words(("too short", "II", "I", "too long"))
    'too short, class II, I or too long'
    """
    return language.words_of(grades.choice_words(names))


# Reasons of the core for a class whose texts it puts together.
_REASONS = (
    *(marked("no centreline length"), marked("no thread length"), marked("no chord length")),
)


def grade_words(graded: Grade) -> str:
    """Return a class with its reason, as `Grade.words` does in English.

    Examples
    --------
    >>> from cucumbervision.crop.grades import UNDECIDED, Grade, GradeStatus
    >>> grade_words(Grade(GradeStatus.UNDECIDED, UNDECIDED, (), {}, possible=("II", "I")))
    'undecided: class II or I'
    """
    return language.words_of(graded.words)


def length_words(record: FruitRow, units: Units) -> str:
    """Return a length in words: 'at least' for a lower bound, 'not measured' for none.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> length_words(FruitRow(1, length=Length(0.241), flags="end-hidden"), Units("cm"))
    'at least 24.1 cm'
    """
    if record.length_m is None:
        return _("not measured")
    length = units.text(record.length_m)
    return _("at least {length}").format(length=length) if record.at_least else length


def today_words(view: FruitRow, length_m: float | None, units: Units) -> str:
    """Return a length as measured, and where growth is expected since then both.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> fruit = FruitRow(1, length=Length(0.155), taken_s=1_700_000_000.0)
    >>> today_words(fruit, None, Units("cm")), today_words(fruit, 0.215, Units("cm"))
    ('15.5 cm', 'today about 21.5 cm (15.5 cm on Tue 14 Nov)')
    """
    measured = length_words(view, units)
    if length_m is None:
        return measured
    return _("today about {today} ({length} on {day})").format(
        today=units.text(length_m), length=measured, day=day_words(view.taken_s)
    )


def interval_words(record: FruitRow, units: Units, words: str = "") -> str | None:
    """Return a length's interval from end to end; None where it has none, or is a lower bound.

    Parameters
    ----------
    record : FruitRow
        The fruit.
    units : Units
        Unit of lengths.
    words : str
        Other words around {low} and {high}.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> record = FruitRow(1, length=Length(0.24, low_m=0.235, high_m=0.247))
    >>> interval_words(record, Units("cm"))
    '23.5 to 24.7 cm'
    """
    length = record.length
    if length is None or record.at_least or not (length.low_m and length.high_m):
        return None
    return (words or _("{low} to {high}")).format(
        low=language.number_words(units.value(length.low_m) or 0.0, units.digits),
        high=units.text(length.high_m),
    )


def kind_words(kind: str | None) -> str:
    """Return the kind of a length in words.

    Examples
    --------
    >>> kind_words("centreline"), kind_words(None)
    ('Length along the middle', 'Length')
    """
    return {
        "centreline": _("Length along the middle"),
        "thread": _("Length over the outer side"),
        "chord": _("Length straight from end to end"),
    }.get(kind or "", _("Length"))


_LEVEL_M = 0.2  # from the camera's height, upwards or downwards


def height_words(record: FruitRow) -> str:
    """Return whether a fruit hangs high or low in its image; empty in between, or if unknown.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> height_words(FruitRow(1, centre_y_m=-0.312)), height_words(FruitRow(1, centre_y_m=0.1))
    ('hangs high', '')
    """
    down_m = record.centre_y_m or 0.0
    return "" if abs(down_m) < _LEVEL_M else _("hangs low") if down_m > 0 else _("hangs high")


def added_words(*, doubtful: bool) -> str:
    """Return the outcome of adding a fruit in words."""
    if doubtful:
        return _(
            "Added, but it does not look like a fruit. It is not on the pick list until someone "
            "accepts it. 'Undo' removes it."
        )
    return _("Added to the round. 'Undo' removes it.")


def remarks(record: FruitRow, units: Units) -> str:
    """Return the remarks on a fruit, as short sentences; technical flags are left out.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> fruit = FruitRow(1, length=Length(0.24), flags="ends-unsure end-hidden")
    >>> remarks(fruit, Units("cm"))
    'an end is hidden: at least 24.0 cm'
    """
    meanings = [FLAGS.get(code) for code in record.flags.split()]
    remarks = dict.fromkeys(_(x.remark) for x in meanings if x is not None and x.remark)
    words = "; ".join(remarks)
    if not (record.at_least and record.length_m is not None):
        return words
    return f"{words or _('partly hidden')}: {length_words(record, units)}"


_FORECAST_Z = 1.2816  # half of an 80 % interval, in standard deviations


def daily_growth_words(growth_m_per_day: float | None, units: Units) -> str:
    """Return the growth of a day.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> daily_growth_words(0.0182, Units("cm")), daily_growth_words(None, Units("cm"))
    ('1.8 cm a day', '–')
    """
    growth = units.text(growth_m_per_day)
    return growth if growth_m_per_day is None else _("{growth} a day").format(growth=growth)


def count_words(expected: float) -> str:
    """Return an expected number of fruit or kg: below 100 to a tenth.

    Examples
    --------
    >>> count_words(3.84), count_words(4.0), count_words(120.04)
    ('3.8', '4', '120')
    """
    return language.decimal_words(f"{round(expected, int(expected < 100)):g}")


def ready_words(ready: Ready) -> str:
    """Return how many fruit are ready today.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.picking import Ready
    >>> ready_words(Ready({"I": 5.6}, 2, 12, 0))
    'Ready today: 5.6 (sure 2, may be 12)'
    """
    words = _("Ready today: {expected} (sure {sure}, may be {may_be})")
    return words.format(expected=count_words(ready.fruit), sure=ready.sure, may_be=ready.may_be)


def span_words(span: Span) -> str:
    """Return an expected number of fruit with its interval.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.picking import Span
    >>> span_words(Span(3.8, 3.0, 5.0)), span_words(Span(4, 4, 4)), span_words(Span(0, 0, 0))
    ('3.8 (3 to 5)', '4', '–')
    """
    words = count_words(span.expected)
    if words == "0" or span.low == span.high:
        return "–" if words == "0" else words
    ends = _("{low} to {high}").format(low=f"{span.low:.0f}", high=f"{span.high:.0f}")
    return f"{words} ({ends})"


def growth_words(growth: Growth, units: Units) -> str:
    """Return the growth that a forecast expects of its house in words, and where it comes from.

    Examples
    --------
    >>> from cucumbervision.crop.profiles import load_profile
    >>> from cucumbervision_greenhouse.forecast.growth import FruitState, GrowthPrior, fit_growth
    >>> from cucumbervision_greenhouse.settings import Units
    >>> prior = GrowthPrior.of(load_profile("long-cucumber"))
    >>> growth_words(fit_growth([], prior), Units("cm"))
    'Expected growth: 3.0 cm a day (2.0 to 4.0), by the crop profile, as no fruit was seen on two
    days (2 to 4 cm a day: the CucumberVision paper, ...).'
    >>> fruit = [FruitState("a", "1", 0, 0.28, 0.003, 2, earlier=((0, 0.2, 0.003),))]
    >>> growth_words(fit_growth(fruit, prior), Units("in"))
    'Expected growth: 1.41 in a day (1.15 to 1.67), by 1 fruit seen on several days and the crop
    profile.'
    """
    low, mean, high = (
        max(growth.mean_m + z * growth.mean_sd_m, 0.0) for z in (-_FORECAST_Z, 0, _FORECAST_Z)
    )
    parts = {
        "growth": units.text(mean),
        "low": language.number_words(units.value(low) or 0.0, units.digits),
        "high": language.number_words(units.value(high) or 0.0, units.digits),
    }
    if growth.fruit:
        return counted(
            growth.fruit,
            "Expected growth: {growth} a day ({low} to {high}), by {n} fruit seen on several days "
            "and the crop profile.",
            "Expected growth: {growth} a day ({low} to {high}), by {n} fruit seen on several days "
            "and the crop profile.",
            **parts,
        )
    source = f" ({growth.prior.source})" if growth.prior.source else ""
    words = _(
        "Expected growth: {growth} a day ({low} to {high}), by the crop profile, as no fruit was "
        "seen on two days{source}."
    )
    return words.format(**parts, source=source)


def hours_words(hours: float) -> str:
    """Return hours of work; less than 1.5 hours as minutes, rounded up.

    Examples
    --------
    >>> hours_words(0.31), hours_words(3.24)
    ('19 min', '3.2 h')
    """
    if hours >= 1.5:
        return _("{hours} h").format(hours=language.number_words(hours, 1))
    return f"{math.ceil(60 * hours - 1e-9):d} min"


def hours_span_words(span: Span) -> str:
    """Return hours of work with their interval, each as in `hours_words`.

    Examples
    --------
    >>> from cucumbervision_greenhouse.forecast.picking import Span
    >>> hours_span_words(Span(0.31, 0.2, 0.5)), hours_span_words(Span(3.24, 2.9, 4.0))
    ('19 min (12 min to 30 min)', '3.2 h (2.9 h to 4.0 h)')
    """
    lower, expected, upper = map(hours_words, (span.low, span.expected, span.high))
    if lower == upper:
        return expected
    return f"{expected} ({_('{low} to {high}').format(low=lower, high=upper)})"


def forecast_day(prediction: Forecast, day: int) -> str:
    """Return the name of a day of a forecast, counted from its day 0."""
    return date_words(date_after(prediction.today * DAY_S, day), date.today())


def first_days(prediction: Forecast) -> dict[str, int]:
    """Return the first day on which a fruit is expected in each class that is picked."""
    first = {}
    for k, name in enumerate(prediction.classes):
        (days,) = np.nonzero(prediction.house.expected[:, k] >= 1)
        if name in prediction.pick and len(days):
            first[name] = int(prediction.days[days[0]])
    return first


def expected_classes(prediction: Forecast) -> list[int]:
    """Return which classes any fruit may be in on any of the days."""
    return [k for k in range(len(prediction.classes)) if prediction.house.high[:, k].max() >= 1]
