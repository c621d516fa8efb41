from __future__ import annotations

import pytest

pytest.importorskip("markdown_it")

from markdown_it import MarkdownIt

from cucumbervision.dashboard.words import plain


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
    ],
)
def test_a_name_is_drawn_as_it_is(name: str) -> None:
    (paragraph,) = [
        token for token in MarkdownIt("commonmark").parse(plain(name)) if token.type == "inline"
    ]
    assert {child.type for child in paragraph.children or []} <= {"text", "text_special"}
    assert "".join(child.content for child in paragraph.children or []) == name


def test_streamlits_own_marks_are_text() -> None:
    assert plain(":red[x] :tada: $a$") == r"\:red\[x\] \:tada\: \$a\$"
    assert plain("two\nlines") == "two lines"
