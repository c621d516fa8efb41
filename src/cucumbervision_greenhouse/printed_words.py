"""The printed page in the language that is shown: its texts, and the core's words in its cells."""

from __future__ import annotations

import re
from datetime import date

from cucumbervision_greenhouse.exports.writers import PageWords
from cucumbervision_greenhouse.language import day_month_words, decimal_words, language, marked
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.resources import crop_titles, settings
from cucumbervision_greenhouse.words import hours_words, label_words

# What a cell joins of the core's words: remarks, reasons in brackets, classes that are possible.
_JOINTS = re.compile(r"(; |: |, | \(|\)| or )")
_LEAST = re.compile(r"at least (\d+\.\d) cm")
_IN_CELLS = (
    *(marked("picked"), marked("drawn, not grown"), marked("partly hidden")),
    *(marked("ready"), marked("may be ready"), marked("no crop profile was named")),
)


def printed_words() -> PageWords:
    """Return how the printed page writes in the language that is shown."""
    titles, inches = crop_titles(), settings().unit == "in"
    return PageWords(
        language(),
        printed_text,
        decimal_words,
        _day,
        hours_words,
        crop=lambda name: titles.get(name, name),
        inches=inches,
    )


def printed_text(text: str) -> str:
    """Return a text of the page in the language that is shown; of a cell, what is known of it.

    Examples
    --------
    >>> printed_text("class II (by length)"), printed_text("an end is hidden: at least 24.1 cm")
    ('class II (by length)', 'an end is hidden: at least 24.1 cm')
    """
    if (whole := _(text)) != text:
        return whole
    if "; " in text:
        return "; ".join(map(printed_text, text.split("; ")))
    return "".join(map(_part, _JOINTS.split(text)))


def _part(text: str) -> str:
    if bound := _LEAST.fullmatch(text):
        length = settings().units.text(float(bound[1]) / 100)
        return _("at least {length}").format(length=length)
    if text.startswith("class "):
        return label_words(text)
    return _(text)


def _day(day: str) -> str:
    return day_month_words(date.fromisoformat(day))
