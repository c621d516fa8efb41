"""How the printed page writes texts, numbers and dates: in English, unless others are given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cucumbervision.crop.grades import WITHOUT_CLASS
from cucumbervision_greenhouse.forecast.picking import hours_words


@dataclass(frozen=True)
class PageWords:
    """The language of the printed page.

    Parameters
    ----------
    code : str
        Its code, as in HTML.
    text : callable
        Translates a text of the page, or of a table's cell, from English.
    decimals : callable
        Writes the decimal mark of a number that has a point.
    day : callable
        Writes a date that is given as in ISO 8601.
    hours : callable
        Writes hours of work.
    crop : callable
        Gives the title of a crop profile by its name.
    inches : bool
        Lengths are in inches and positions in feet, instead of in centimetres and metres.

    Examples
    --------
    >>> PageWords().class_name("I"), PageWords().class_name("too long")
    ('class I', 'too long')
    """

    code: str = "en"
    text: Callable[[str], str] = str
    decimals: Callable[[str], str] = str
    day: Callable[[str], str] = str
    hours: Callable[[float], str] = hours_words
    crop: Callable[[str], str] = str
    inches: bool = False

    def class_name(self, name: str) -> str:
        """Return the name of a class for people."""
        if name in WITHOUT_CLASS:
            return self.text(name)
        return self.text("class {name}").format(name=name)


ENGLISH = PageWords()
