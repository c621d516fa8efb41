"""Check the names that people give to rows, sides, rounds, houses and stops."""

from __future__ import annotations

import re
from collections.abc import Iterable
from unicodedata import category, normalize

from cucumbervision.errors import Message, NameRefusedError

# They change the direction of the text after the name, in every list and file.
_DIRECTION_MARKS = frozenset(
    "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
)
_NO_LETTERS = ("Cc", "Cs", "Zl", "Zp")  # control, half of a pair, ends of lines and paragraphs
_SHOWN_CHARACTERS = 40
LONGEST_NAME = 200
"""Most characters of a name; more do not fit on a page, a label or a file."""

_HOUSE = re.compile(r"^house(?:[\W_]+|(?=\d))(?=.)")


def checked_name(text: str, what: str = "name", longest: int | None = LONGEST_NAME) -> str:
    r"""Return a name without spaces around it, after checking that it is one line that can be read.

    Letters of every script are allowed, and so is text that looks like markup or a formula: pages
    and files show it unchanged.

    Parameters
    ----------
    text : str
        The name as entered.
    what : str
        Kind of name, for the error message.
    longest : int, optional
        Most characters; None for a name that files and folders gave.

    Raises
    ------
    NameRefusedError
        If it has a control character, a line's end, half of a surrogate pair, or a mark that turns
        the direction of writing, or is too long.

    Examples
    --------
    >>> checked_name(" Reihe süd/黄瓜 "), checked_name("=1+1 ![x](http://a)")
    ('Reihe süd/黄瓜', '=1+1 ![x](http://a)')
    >>> checked_name("3\u202e", "row")
    Traceback (most recent call last):
    cucumbervision.errors.NameRefusedError: the row '3?' contains U+202E, ...
    """
    name = text.strip()
    bad = next((c for c in name if _is_unreadable(c)), None)
    if longest is not None and len(name) > longest:
        fault = "the {what} '{name}' has {count} characters, and {most} are taken"
        remedy = "shorten it"
    elif bad is not None:
        fault = "the {what} '{name}' contains U+{sign:04X}, which is no letter or sign"
        remedy = "type it again; only letters, digits, signs and spaces"
    else:
        return name
    parts = {"name": readable(name[:_SHOWN_CHARACTERS]), "count": len(name), "most": longest}
    raise NameRefusedError(fault, remedy=remedy, what=Message(what), sign=ord(bad or "?"), **parts)


def readable(text: str) -> str:
    r"""Return a text with a question mark for every character that a name may not contain.

    Examples
    --------
    >>> readable("a\u202eb"), readable("a\tb")
    ('a?b', 'a?b')
    """
    return "".join("?" if _is_unreadable(c) else c for c in text)


def _is_unreadable(character: str) -> bool:
    return character in _DIRECTION_MARKS or category(character) in _NO_LETTERS


def house_key(house: str) -> str:
    """Return a house name for comparison: no case, no spaces, no leading word 'house'.

    Examples
    --------
    >>> [house_key(name) for name in ("7", "House 7", " HOUSE  7 ", "house7")]
    ['7', '7', '7', '7']
    >>> [house_key(name) for name in ("House", "Hothouse 7", "Housekeeper's")]
    ['house', 'hothouse7', "housekeeper's"]
    """
    name = " ".join(normalize("NFKC", house).casefold().split())
    return "".join(_HOUSE.sub("", name).split())


def same_house(house: str, houses: Iterable[str]) -> str:
    """Return the known house that a name means, or the name itself if none is meant.

    A house of exactly this name wins; otherwise the first with the same `house_key`.

    Examples
    --------
    >>> same_house("7", ["Nord", "House 7"]), same_house(" Süd  2", ["Nord"])
    ('House 7', 'Süd 2')
    """
    name, house_names = " ".join(house.split()), [text for text in houses if text]
    if not name or name in house_names:
        return name
    return next((text for text in house_names if house_key(text) == house_key(name)), name)
