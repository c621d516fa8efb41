"""Return the class of a fruit from the interval of its length.

A fruit is in a class if its whole interval is, and undecided if the interval spans several. Of a
fruit that continues out of sight only a lower bound is known; it is never too short.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import Message, joined

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

UNDECIDED = "undecided"
"""What a fruit is called whose interval spans several classes."""

NO_CLASS = "no class"
"""What a fruit is called whose shape, weight or girth no class allows."""

NOT_MEASURED = "not measured"
"""What a fruit without a length is called."""

WITHOUT_CLASS = ("too short", "too long", NO_CLASS, UNDECIDED, NOT_MEASURED)
"""All names that are no class of a crop."""

_SAME_M = 1e-8  # lengths nearer than that are equal: 0.1 + 0.15 m is 25 cm


def possible_classes(
    low_m: float, high_m: float, edges_m: NDArray[np.float64], names: Sequence[str]
) -> tuple[str, ...]:
    """Return the classes that an interval of the length spans, without repeats, shortest first.

    Parameters
    ----------
    low_m, high_m : float
        Ends of the interval, metres; the upper end of a lower bound is infinite.
    edges_m : ndarray of float64, shape (B - 1,)
        Limits between the classes, ascending; a class includes its lower limit.
    names : sequence of str, length B
        Class of each bin between the limits, including the two outer bins.

    Examples
    --------
    >>> edges, names = np.array([0.20, 0.25, 0.35]), ("too short", "II", "I", "too long")
    >>> possible_classes(0.26, 0.28, edges, names)
    ('I',)
    >>> possible_classes(0.24, 0.26, edges, names)
    ('II', 'I')
    >>> possible_classes(0.13, float("inf"), edges, names)
    ('too short', 'II', 'I', 'too long')
    """
    first = int(np.searchsorted(edges_m, low_m + _SAME_M, side="right"))
    last = int(np.searchsorted(edges_m, max(high_m, low_m) - _SAME_M, side="right"))
    return tuple(dict.fromkeys(names[first : max(first, last) + 1]))


def class_of(possible: Sequence[str]) -> str:
    """Return the only possible class, or 'undecided'.

    Examples
    --------
    >>> class_of(("I",)), class_of(("II", "I"))
    ('I', 'undecided')
    """
    return possible[0] if len(possible) == 1 else UNDECIDED


def class_name(name: str) -> str:
    """Return the name of a class for people.

    Examples
    --------
    >>> class_name("I"), class_name("too long")
    ('class I', 'too long')
    """
    return Message(name) if name in WITHOUT_CLASS else Message("class {name}", name=name)


def choice_words(names: Iterable[str]) -> str:
    """Return several classes for people.

    Examples
    --------
    >>> choice_words(("II", "I")), choice_words(("I", "too long"))
    ('class II or I', 'class I or too long')
    >>> choice_words(("too short", "II", "I", "too long"))
    'too short, class II, I or too long'
    """
    words: list[str] = []
    for name in names:
        # 'class' once before a run of classes.
        follows = bool(words) and words[-1] not in WITHOUT_CLASS
        words.append(name if follows and name not in WITHOUT_CLASS else class_name(name))
    return joined(words, "{first} or {second}")
