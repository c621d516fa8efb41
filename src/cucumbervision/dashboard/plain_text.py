"""Names and errors on a page as they are: Streamlit takes what it draws for Markdown."""

from __future__ import annotations

import re

# Marks of Markdown, of HTML, of Streamlit's own colours and icons (:red[x], :tada:) and of TeX.
_MARKS = re.compile(r"([\\`*_{}\[\]()#+!|~<>:$&-])")
_LINE_STARTS = re.compile(r"(?m)^(\s*\d+)\.")


def plain(text: object) -> str:
    r"""Return a text that Streamlit draws letter by letter, on one line.

    Examples
    --------
    >>> plain("row [3](http://x) *a*")
    'row \\[3\\]\\(http\\://x\\) \\*a\\*'
    """
    words = " ".join(str(text).split())
    return _LINE_STARTS.sub(r"\1\\.", _MARKS.sub(r"\\\1", words))
