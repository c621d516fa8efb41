"""What the pages say of rounds, rows, stops and what was done to them."""

from __future__ import annotations

import time
from datetime import date, datetime
from typing import TYPE_CHECKING

from cucumbervision_greenhouse.backend.language import (
    counted,
    day_month_words,
    marked,
    moment_words,
    number_words,
)
from cucumbervision_greenhouse.backend.language import gettext as _
from cucumbervision_greenhouse.rounds.demonstration import is_demonstration

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Stop
    from cucumbervision_greenhouse.backend.settings import Units
    from cucumbervision_greenhouse.store.views import LogEntry, RoundSummary, StopSummary

_DEMONSTRATION = marked("Demonstration (computer-made example)")


def position_words(along_m: float | None, units: Units) -> str:
    """Return a position along a row in words; a negative position is shown as 0.

    Examples
    --------
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> [position_words(1.204, Units(name)) for name in ("cm", "in")]
    ['1.20 m', '3.95 ft']
    """
    name, per_metre = units.along
    return f"{number_words(max(along_m or 0.0, 0.0) * per_metre, 2)} {name}"


def round_day(at_s: float) -> str:
    """Return a moment as local day and time.

    Examples
    --------
    >>> len(round_day(1_700_000_000.0))
    17
    """
    return moment_words(datetime.fromtimestamp(at_s))


def day_words(at_s: float) -> str:
    """Return a moment as local weekday and date.

    Examples
    --------
    >>> day_words(1_700_000_000.0)
    'Tue 14 Nov'
    """
    return day_month_words(date.fromtimestamp(at_s))


def date_words(day: date, today: date) -> str:
    """Return a day in words: 'today', 'tomorrow', or the weekday and date.

    Examples
    --------
    >>> [date_words(date(2023, 11, day), date(2023, 11, 14)) for day in (13, 14, 15, 16)]
    ['Mon 13 Nov', 'today', 'tomorrow', 'Thu 16 Nov']
    """
    return {0: _("today"), 1: _("tomorrow")}.get((day - today).days, day_month_words(day))


def _name_of(round_summary: RoundSummary) -> str:
    name = round_summary.record.name
    return _(name) if is_demonstration(round_summary.key) else name


def round_name(round_summary: RoundSummary) -> str:
    """Return a round's name in a list: its name, house, day and number of stops."""
    house = f", {round_summary.record.house}" if round_summary.record.house else ""
    stops = counted(round_summary.stops, "stop", "stops")
    name, day = _name_of(round_summary) or _("Round"), round_day(round_summary.walked_s)
    return f"{name}{house} · {day} · {stops}"


_ACTIONS = {
    "accept": marked("accepted"),
    "reject": marked("not a fruit"),
    "clear": marked("no longer accepted, nor marked as no fruit"),
    "pick": marked("picked"),
    "unpick": marked("not picked"),
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
    >>> from cucumbervision_greenhouse.store.views import LogEntry
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
    """Return what is said of an action that was undone.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.views import LogEntry
    >>> taken_back(LogEntry(7, 0.0, "ana", "reject", None, ("a",)))
    'Taken back: not a fruit'
    """
    return _("Taken back: {action}").format(action=action_words(action))


def stop_name(stop: Stop | StopSummary, units: Units) -> str:
    """Return the place of a stop in words.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> from cucumbervision_greenhouse.backend.settings import Units
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


def clock_words(walked_s: float) -> str:
    """Return what is said of a round that is later than this machine's clock."""
    return _(
        "The last stop ({when}) is later than this computer's clock ({now}): set the clock. Until "
        "then days, growth and what is left to pick are not right."
    ).format(when=round_day(walked_s), now=round_day(time.time()))


def age_words(days: int) -> str:
    """Return an age in days as text.

    Examples
    --------
    >>> age_words(0), age_words(1), age_words(4), age_words(400)
    ('of today', 'of yesterday', '4 days old', '1 year old')
    """
    if days < 2:
        return _("of yesterday") if days == 1 else _("of today")
    if days < 60:
        return counted(days, "{n} day old", "{n} days old")
    if days < 365:
        return counted(days // 30, "{n} month old", "{n} months old")
    return counted(days // 365, "{n} year old", "{n} years old")
