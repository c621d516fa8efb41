from __future__ import annotations

import re

import pytest

pytest.importorskip("markdown_it")

from markdown_it import MarkdownIt

from cucumbervision_greenhouse.backend.words import page_remedy, plain

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


@pytest.mark.parametrize(
    "line",
    [
        "made for another camera; calibrate this camera, or measure it without --calibration",
        "align depth to colour, or say so with --aligned-to color",
        "the colour picture was aligned to depth, say so with --aligned-to depth",
        "check the unit of depth (--depth-unit 0.001 is 1 mm a step)",
        "no fruit has a possible size: --depth-unit 0.001 or 0.0001 would explain it",
        "begin its name as the pictures' (cam1_intrinsics.json), or give --intrinsics",
        "a recording's depth is along the axis; leave out --depth-along and --aligned-to",
        "leave --input-size out, or export the network with dynamic sizes",
        "put them into mask_visib/, or choose other --instances",
        "measured as fruit: 2 of class cucumber, 1 of class leaf; --classes chooses among them",
    ],
)
def test_a_remedy_on_a_page_names_no_option_of_a_command(line: str) -> None:
    assert "--" not in page_remedy(line)
