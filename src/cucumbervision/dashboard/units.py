"""Lengths in the unit that people read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["UNITS", "Units"]

UNITS = {"cm": 100.0, "in": 1 / 0.0254}


@dataclass(frozen=True)
class Units:
    """A unit of length for people.

    Parameters
    ----------
    name : {'cm', 'in'}
        Centimetres or inches.

    Examples
    --------
    >>> Units("cm").text(0.2532), Units("in").text(0.2532), Units("cm").text(None)
    ('25.3 cm', '9.97 in', '–')
    """

    name: Literal["cm", "in"] = "cm"

    def value(self, length_m: float | None) -> float | None:
        """Give metres in this unit.

        Examples
        --------
        >>> Units("in").value(0.254)
        10.0
        """
        return None if length_m is None else round(length_m * UNITS[self.name], 3)

    def metres(self, value: float) -> float:
        """Give a value in this unit as metres.

        Examples
        --------
        >>> Units("cm").metres(25.0)
        0.25
        """
        return value / UNITS[self.name]

    @property
    def digits(self) -> int:
        """How many decimals are worth reading."""
        return 1 if self.name == "cm" else 2

    def text(self, length_m: float | None) -> str:
        """Write a length with its unit."""
        value = self.value(length_m)
        return "–" if value is None else f"{value:.{self.digits}f} {self.name}"
