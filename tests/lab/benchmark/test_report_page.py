from __future__ import annotations

import json
import re
import sys
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

import pytest

from cucumbervision.about import source_offer
from cucumbervision.accuracy.table import Table
from cucumbervision.errors import MissingExtraError
from cucumbervision_lab.benchmark.report import HTML_NAME, JSON_NAME, Plot, Section, write_report

if TYPE_CHECKING:
    from pathlib import Path

EVIL = "<script>alert('x')</script> & co"
BURST = Table.of("Burst size", ["frames", "MAPE (%)"], [[1, 0.75]], "Few help.")
PNG = b"\x89PNG not read by the page"


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
        [
            Section("First", ("Why.",), (BURST, Plot("A plot.", PNG))),
            Section("Second", (), (BURST,)),
        ],
        glance=Table.of("At a glance", ["part"], [["all"]]),
        notes=["One.", EVIL],
        provenance={"seed": 7, "models": [], "versions": {"numpy": "2"}, "quick": False},
        glossary=[("MAPE", "Mean error.")],
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
    assert numbers["notes"] == ["One.", EVIL]


def test_the_parts_stand_in_order(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    wanted = ["Benchmark", "At a glance", "How to read this", "First", "Burst size"]
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
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[benchmark\]"):
        write_report(tmp_path / "out", "x", [], glance=BURST)
    assert not (tmp_path / "out").exists()
