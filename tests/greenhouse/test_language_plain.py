from __future__ import annotations

import re

import pytest

pytest.importorskip("markdown_it")

from markdown_it import MarkdownIt

from cucumbervision_greenhouse.language import plain

# What Streamlit and Markdown's extensions look for in the text that is drawn, as in their sources.
LIVE = (
    r"(?i)https?://[-.\w]|www\.[-.\w]|[-.\w+]+@[-\w]+(\.[-\w]+)+|:[\w+/-]+:"
    r"|(^|\s)(<->|->|<-|--|>=|<=|~=)(\s|$)"
)


@pytest.mark.parametrize(
    "name",
    [
        "[free money](http://evil.example)",
        "![x](http://evil.example/a.png)",
        "**bold** _it_ `code` ~~gone~~",
        "<img src=x onerror=alert(1)>",
        "# head",
        "1. first",
        "- item",
        "&lt;b&gt;",
        "a\\*b",
        "| a | b |",
        "HTTPS://a.example www.a.example me@a.example",
        ":tada: :+1: :material/delete: :streamlit:",
        "-> <-> <- -- >= <= ~= a->b",
    ],
)
def test_a_name_is_drawn_as_it_is(name: str) -> None:
    (paragraph,) = [
        token for token in MarkdownIt("commonmark").parse(plain(name)) if token.type == "inline"
    ]
    assert {child.type for child in paragraph.children or []} <= {"text", "text_special"}
    drawn = "".join(child.content for child in paragraph.children or [])
    assert drawn.replace("\u2060", "") == name
    assert not re.search(LIVE, drawn)


def test_streamlits_own_marks_are_text() -> None:
    assert plain(":red[x] $a$") == r"\:red\[x\] \$a\$"
    assert plain("two\nlines") == "two lines"
    assert plain("a\u202eb") == "a?b"
