"""Texts that Streamlit draws literally, though it reads text as Markdown; unique names."""

from __future__ import annotations

import re
from itertools import chain, count
from typing import TYPE_CHECKING, TypeVar

from cucumbervision.names import readable

if TYPE_CHECKING:
    from collections.abc import Mapping


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
    r"""Return a text that Streamlit draws literally, on one line.

    Examples
    --------
    >>> plain("row [3](x) *a*")
    'row \\[3\\]\\(x\\) \\*a\\*'
    >>> plain("http://x"), plain("a :tada:")
    ('http\u2060\\://x', 'a \\:\u2060tada\\:')
    """
    words = _FOUND_LATER.sub(rf"\1{_JOINER}", readable(" ".join(str(text).split())))
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
