"""Names that people give: of rows, sides, rounds, houses, stops. One rule for every door."""

from __future__ import annotations

import re
from collections.abc import Iterable
from unicodedata import category, normalize

from cucumbervision.errors import NameRefusedError

# They turn the direction of what follows, in every list and file that quotes the name.
_TURNING = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
_NO_LETTERS = ("Cc", "Cs", "Zl", "Zp")  # control, half of a pair, ends of lines and paragraphs
_SHOWN = 40
_HOUSE = re.compile(r"^house(?:[\W_]+|(?=\d))(?=.)")


def checked_name(text: str, what: str = "name") -> str:
    r"""Return a name without spaces around it, after checking that it is one line that can be read.

    Letters of every script are allowed, and so is whatever looks like markup or a formula: pages
    and files show it as it is.

    Parameters
    ----------
    text : str
        As it was given.
    what : str
        What it names, for the error.

    Raises
    ------
    NameRefusedError
        If it has a control character, a line's end, half of a surrogate pair, or a mark that turns
        the direction of writing.

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
    if bad is not None:
        shown = readable(name)[:_SHOWN]
        raise NameRefusedError(
            f"the {what} '{shown}' contains U+{ord(bad):04X}, which is no letter or sign",
            remedy="type it again; only letters, digits, signs and spaces",
        )
    return name


def readable(text: str) -> str:
    r"""Return a text with a question mark in place of what no name may contain.

    Examples
    --------
    >>> readable("a\u202eb"), readable("a\tb")
    ('a?b', 'a?b')
    """
    return "".join("?" if _is_unreadable(c) else c for c in text)


def _is_unreadable(character: str) -> bool:
    return character in _TURNING or category(character) in _NO_LETTERS


def house_key(house: str) -> str:
    """Return what tells a house from others: no case, no spaces, no leading word 'house'.

    Examples
    --------
    >>> [house_key(name) for name in ("7", "House 7", " HOUSE  7 ", "house7")]
    ['7', '7', '7', '7']
    >>> [house_key(name) for name in ("House", "Hothouse 7", "Housekeeper's")]
    ['house', 'hothouse7', "housekeeper's"]
    """
    name = " ".join(normalize("NFKC", house).casefold().split())
    return "".join(_HOUSE.sub("", name).split())


def same_house(house: str, known: Iterable[str]) -> str:
    """Return the known house that a name means: of that name, or the first; else the name itself.

    Examples
    --------
    >>> same_house("7", ["Nord", "House 7"]), same_house(" Süd  2", ["Nord"])
    ('House 7', 'Süd 2')
    """
    name, houses = " ".join(house.split()), [one for one in known if one]
    if not name or name in houses:
        return name
    return next((one for one in houses if house_key(one) == house_key(name)), name)
