from __future__ import annotations

import json
import math
import re
import sys
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from cucumbervision.about import source_offer
from cucumbervision.accuracy.page import (
    HTML_NAME,
    JSON_NAME,
    Column,
    Picture,
    Section,
    Table,
    write_report,
)
from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from pathlib import Path

EVIL = "<script>alert('x')</script> & co"
BURST = Table.of("Burst size", ["frames", "MAPE (%)"], [[1, 0.75]], "Few help.")
PNG = b"\x89PNG not read by the page"


def test_a_row_with_a_cell_too_few_is_refused() -> None:
    with pytest.raises(ValueError, match="1 cells in a row of 2 columns"):
        Table("t", (Column("a"), Column("b")), ((1,),))


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (1.005, "1.00"),  # 1.005 is a little less in binary
        (-1.5, "−1.50"),
        (12, "12"),
        ("M1", "M1"),
        (True, "yes"),
        (False, "no"),
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "–"),
    ],
)
def test_a_cell_as_text(cell: float | str | None, text: str) -> None:
    assert Column("a").show(cell) == text


def test_numpy_numbers_become_json() -> None:
    table = Table.of("t", ["a", "b"], [[np.int64(3), np.float32(0.5)]])
    assert json.loads(json.dumps(table.as_json()))["rows"] == [{"a": 3, "b": 0.5}]


def test_json_keeps_every_digit_and_text_does_not() -> None:
    table = Table.of("t", ["a:.1"], [[1 / 3]])
    assert table.as_json()["rows"][0]["a"] == 1 / 3
    assert table.text_rows() == [["0.3"]]


def test_only_numbers_and_gaps_make_a_numeric_column() -> None:
    table = Table.of("t", ["a", "b", "c"], [[1, "x", None], [None, 2.0, 3.0]])
    assert table.numeric == [True, False, True]


class Page(HTMLParser):
    """Collects what a browser would load, and what it would show."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.heads: list[str] = []
        self.alts: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        found = dict(attrs)
        self.links += [value for name in ("src", "href") if (value := found.get(name))]
        self.ids += [value for name in ("id",) if (value := found.get(name))]
        if tag == "img":
            self.alts.append(found.get("alt") or "")

    def handle_data(self, data: str) -> None:
        self.text += data
        if self.tags and self.tags[-1] in ("h1", "h2", "h3") and data.strip():
            self.heads.append(data.strip())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("jinja2")
    out = tmp_path_factory.mktemp("report") / "new"
    write_report(
        out,
        "Benchmark",
        Table.of("At a glance", ["part"], [["all"]]),
        [
            Section("First", ("Why.",), (BURST, Picture("A plot.", PNG))),
            Section("Second", (), (BURST,)),
        ],
        notes=[("", "One.\n\nTwo."), ("Beware", EVIL)],
        provenance={"seed": 7, "models": [], "versions": {"numpy": "2"}, "quick": False},
        glossary=[("MAPE", "Mean error.")],
        numbers={"records": 26},
    )
    return out


@pytest.fixture
def written(folder: Path) -> tuple[Page, dict[str, Any]]:
    page = Page()
    page.feed((folder / HTML_NAME).read_text(encoding="utf-8"))
    return page, json.loads((folder / JSON_NAME).read_text(encoding="utf-8"))


def test_the_page_needs_nothing_else(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    for link in page.links:
        assert link.startswith(("data:image/png;base64,", "#")), link
    assert page.alts == ["A plot."]


def test_links_lead_somewhere_and_names_are_unique(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    assert len(page.ids) == len(set(page.ids))
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)


def test_nothing_that_was_passed_in_becomes_markup(written: tuple[Page, dict[str, Any]]) -> None:
    page, numbers = written
    assert EVIL in page.text
    assert numbers["notes"] == {"summary": "One.\n\nTwo.", "Beware": EVIL}


def test_the_parts_stand_in_order(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    wanted = ["Benchmark", "Beware", "At a glance", "How to read this", "First", "Burst size"]
    wanted += ["Second", "Where the numbers come from"]
    heads = [head for head in re.split(r"\n", "\n".join(page.heads)) if head in wanted]
    assert list(dict.fromkeys(heads)) == wanted
    assert "One." in page.text
    assert "Mean error." in page.text


def test_source_and_licence_are_offered(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    assert source_offer() in page.text
    assert "AGPL-3.0" in page.text


def test_json_holds_what_the_page_shows(written: tuple[Page, dict[str, Any]]) -> None:
    page, numbers = written
    assert numbers["records"] == 26
    assert [section["title"] for section in numbers["sections"]] == ["First", "Second"]
    assert numbers["sections"][0]["tables"] == [BURST.as_json()]
    assert "0.75" in page.text
    assert numbers["provenance"] == {
        "seed": "7",
        "models": "–",
        "versions": "numpy 2",
        "quick": "no",
    }


def test_without_jinja2_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[report\]"):
        write_report(tmp_path / "out", "x", BURST, [])
    assert not (tmp_path / "out").exists()
