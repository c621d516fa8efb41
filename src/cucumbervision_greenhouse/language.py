"""The language of the pages: their texts from catalogues, numbers and dates as it writes them.

A text is written in English where it is shown, inside `_` (or `ngettext`, `counted`), and is its
own key in `locale/*.po`. `scripts/catalogue` collects the texts and compiles the catalogues. Here
are also the marks that keep Streamlit from reading a text as Markdown.
"""

from __future__ import annotations

import gettext as catalogues
import json
import re
import string
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from datetime import date, datetime
from functools import lru_cache
from html import escape
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeVar

from cucumbervision.errors import CucumberVisionError, Message
from cucumbervision.names import readable

LANGUAGES = {"en": "English", "nl": "Nederlands (concept)", "es": "Español (borrador)"}
"""Languages of the pages by their codes; English is the source, others are drafts."""

LOCALE = Path(__file__).with_name("locale")
_IN_PAGES = re.compile(r'(=?)(?<![\w.])_\(("(?:[^"\\]|\\.)*")\)')  # in JavaScript and HTML

_asked: ContextVar[str] = ContextVar("asked_language", default="")
_deciding: list[Callable[[], str]] = [_asked.get]


def language() -> str:
    """Return the code of the language that is shown now.

    Examples
    --------
    >>> language() in LANGUAGES
    True
    """
    chosen = _deciding[0]()
    return chosen if chosen in LANGUAGES else "en"


def decide_by(decide: Callable[[], str]) -> None:
    """Set what decides on the language: a code, or an empty text for English."""
    _deciding[0] = decide


def ask_for(languages: str | None) -> None:
    """Remember the languages that a browser asks for, for the texts of its request."""
    _asked.set(best_of(languages))


def asked_language() -> str:
    """Return the language that the browser of this request asked for; empty for none."""
    return _asked.get()


@lru_cache(maxsize=64)
def best_of(languages: str | None) -> str:
    """Return the first of a browser's languages that there is; empty for none of them.

    Parameters
    ----------
    languages : str, optional
        As in the header Accept-Language, or one tag.

    Examples
    --------
    >>> best_of("fr-BE, nl;q=0.8, en;q=0.9"), best_of("es-MX"), best_of("fr"), best_of(None)
    ('en', 'es', '', '')
    """

    def wish(part: str) -> float:
        quality = re.search(r";\s*q=([01](?:\.\d{0,3})?)", part)
        return -float(quality[1]) if quality else -1.0

    parts = sorted((languages or "").split(","), key=wish)
    codes = (re.split(r"[-_;]", part.strip().lower())[0] for part in parts)
    return next((code for code in codes if code in LANGUAGES), "")


@lru_cache(maxsize=len(LANGUAGES))
def catalogue(code: str) -> catalogues.GNUTranslations:
    """Return the compiled catalogue of a language.

    That of English holds the remedies alone that name options of commands in the core.
    """
    with (LOCALE / f"{code}.mo").open("rb") as file:
        return catalogues.GNUTranslations(file)


def gettext(text: str) -> str:
    """Return a text in the language that is shown.

    Examples
    --------
    >>> gettext("Row"), gettext("")
    ('Row', '')
    """
    return catalogue(language()).gettext(text) if text else text


def ngettext(singular: str, plural: str, number: int) -> str:
    """Return the form of a text for a number, in the language that is shown.

    Examples
    --------
    >>> ngettext("{n} stop", "{n} stops", 2).format(n=2)
    '2 stops'
    """
    return catalogue(language()).ngettext(singular, plural, number)


def counted(number: int, singular: str, plural: str, **parts: object) -> str:
    """Return a number within its words, in the language that is shown.

    Parameters
    ----------
    number : int
        The number, which `{n}` in the words stands for; without `{n}` it comes first.
    singular, plural : str
        The words for 1 and for any other number, in English.
    **parts
        What other placeholders of the words stand for.

    Examples
    --------
    >>> counted(1, "stop", "stops"), counted(2, "{n} stops of {all}", "{n} stops of {all}", all=3)
    ('1 stop', '2 stops of 3')
    """
    words = ngettext(singular, plural, number)
    return (words if "{n}" in words else f"{{n}} {words}").format(n=number, **parts)


def marked(text: str) -> str:
    """Return a text as it is; it is translated where it is shown."""
    return text


def page_text(source: str, kind: str) -> str:
    """Return a file of a page with its `_("texts")` in the language shown.

    Parameters
    ----------
    source : str
        What the file holds.
    kind : {'js', 'html', 'css'}
        In HTML a text is escaped, and quoted only after `=`.

    Examples
    --------
    >>> page_text('say(_("Undo"))', "js")
    'say("Undo")'
    >>> page_text('<p title=_("Undo")>_("Row")</p>', "html")
    '<p title="Undo">Row</p>'
    """

    def translated(match: re.Match[str]) -> str:
        words = gettext(json.loads(match[2]))
        if kind == "html":
            return f'="{escape(words)}"' if match[1] else escape(words)
        return match[1] + json.dumps(words, ensure_ascii=False)

    return _IN_PAGES.sub(translated, source)


def texts_of(source: str) -> list[str]:
    """Return the texts that `page_text` replaces.

    Examples
    --------
    >>> texts_of('say(_("Undo"), f_("Row"))')
    ['Undo']
    """
    return [json.loads(text) for _, text in _IN_PAGES.findall(source)]


def number_words(value: float, digits: int = 0) -> str:
    """Return a number with its decimals as the language writes it.

    Examples
    --------
    >>> number_words(25.32, 1)
    '25.3'
    """
    return decimal_words(f"{value:.{digits}f}")


def decimal_words(digits: str) -> str:
    """Return a number that is written with a point with the language's decimal mark.

    Examples
    --------
    >>> decimal_words("0.25")
    '0.25'
    """
    return digits if language() == "en" else digits.replace(".", ",")


def day_month_words(day: date) -> str:
    """Return a date with its weekday, without the year.

    Examples
    --------
    >>> day_month_words(date(2023, 11, 4))
    'Sat 4 Nov'
    """
    return _date(day, "EEE d MMM")


def moment_words(moment: datetime) -> str:
    """Return a date with its year and the time of day.

    Examples
    --------
    >>> moment_words(datetime(2023, 11, 4, 9, 5))
    '04 Nov 2023 09:05'
    """
    return _date(moment, "dd MMM y HH:mm")


def _date(moment: date, pattern: str) -> str:
    from babel.dates import format_date, format_datetime

    write = format_datetime if isinstance(moment, datetime) else format_date
    return write(moment, pattern, locale="en_GB" if language() == "en" else language())


Option = TypeVar("Option")


# Marks of Markdown, of HTML, of Streamlit's own colours and icons (:red[x], :tada:) and of TeX.
_MARKS = re.compile(r"([\\`*_{}\[\]()#+!|~<>:$&-])")


_LINE_STARTS = re.compile(r"(?m)^(\s*\d+)\.")


# Texts that Streamlit replaces in spite of escapes: addresses, :names:, and arrows and similar
# signs between spaces.
_FOUND_LATER = re.compile(
    r"(?i)(https?(?=://)|www(?=\.)|@(?=[-\w])|:(?=[\w+/-]+:)"
    r"|(?<!\S)(?:<(?=->(?!\S)|[-=](?!\S))|-(?=[->](?!\S))|[>~](?==(?!\S))))"
)


_JOINER = "\u2060"  # has no width, and breaks no word


def plain(text: object) -> str:
    r"""Return a text, or a message as `words_of` does, that Streamlit draws literally on one line.

    Examples
    --------
    >>> plain("row [3](x) *a*")
    'row \\[3\\]\\(x\\) \\*a\\*'
    >>> plain("http://x"), plain("a :tada:")
    ('http\u2060\\://x', 'a \\:\u2060tada\\:')
    """
    words = _FOUND_LATER.sub(rf"\1{_JOINER}", readable(" ".join(words_of(text).split())))
    return _LINE_STARTS.sub(r"\1\\.", _MARKS.sub(r"\\\1", words))


def sentence(text: object) -> str:
    """Return a text as `plain` does, beginning with a capital.

    Examples
    --------
    >>> sentence("nothing to undo")
    'Nothing to undo'
    """
    words = plain(text)
    return words[:1].upper() + words[1:]


def told_apart(names: Mapping[Option, str]) -> dict[Option, str]:
    """Return options with unique names: repeated ones are numbered, since a choice is by name.

    Examples
    --------
    >>> told_apart({"a": "Row 3", "b": "Row 3", "c": "Row 4", "d": "Row 3"})
    {'a': 'Row 3', 'b': 'Row 3 (2)', 'c': 'Row 4', 'd': 'Row 3 (3)'}
    """
    labels: dict[Option, str] = {}
    used: set[str] = set()
    for option, name in names.items():
        numbered = (f"{name} ({number})" for number in count(2))
        labels[option] = next(label for label in chain([name], numbered) if label not in used)
        used.add(labels[option])
    return labels


class _Local(string.Formatter):
    """Fills parts in as the language writes them."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Message):
            return words_of(value)
        text = super().format_field(value, format_spec)
        return decimal_words(text) if isinstance(value, float) else text


def words_of(text: object) -> str:
    """Return an error, a doubt or a rule of the core in the language shown.

    What has no translation, or is no `Message`, stays English.

    Examples
    --------
    >>> words_of(CucumberVisionError("no fruit", remedy="choose another --input-size"))
    "no fruit; choose the input size in 'Settings'"
    """
    message = text.line if isinstance(text, CucumberVisionError) else text
    if not isinstance(message, Message):
        return str(text)
    template, parts = message.template, message.parts
    if isinstance(number := parts.get("n"), int):
        template = ngettext(template, template, number)
    else:
        template = gettext(template)
    return _Local().vformat(template, (), parts) if parts else template
