from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from cucumbervision.about import source_offer
from cucumbervision.accuracy.records import Masks, Record, Suite
from cucumbervision.accuracy.table import Table
from cucumbervision.errors import CucumberVisionError, MissingExtraError

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from cucumbervision.accuracy.report import HTML_NAME, JSON_NAME, write_report
from cucumbervision.accuracy.sections import Section

if TYPE_CHECKING:
    from pathlib import Path

    from tests.accuracy.conftest import MakeRecord

BURST = Table.of("Burst size", ["frames", "MAPE (%)"], [[1, 0.75]], "Few help.")
EVIL = "<script>alert('x')</script> & co"


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


def records_of(make_record: MakeRecord) -> list[Record]:
    rng = np.random.default_rng(0)
    records = []
    for k in range(12):
        true = float(rng.uniform(0.08, 0.25))
        near = {
            m: true * float(rng.normal(1, sd))
            for m, sd in (("M1", 0.1), ("M5", 0.05), ("M6", 0.01))
        }
        records.append(
            make_record(
                f"p{k}",
                fruit=f"f{k % 4}",
                centreline_m=true,
                thread_m=1.1 * true,
                chord_m=None,
                tilt_deg=5.0 * k,
                lengths_m={**near, "M6 thread": 1.1 * near["M6"], "oracle": true},
                details={"interval_low_m": 0.97 * near["M6"], "interval_high_m": 1.03 * near["M6"]},
            )
        )
    stress = [
        replace(r, suite=Suite.STRESS, masks=Masks.DISTURBED, hidden_share=0.05 * k)
        for k, r in enumerate(records)
    ]
    validation = [replace(r, suite=Suite.VALIDATION) for r in records[:2]]
    return [*records, *stress, *validation]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture
def written(make_record: MakeRecord, folder: Path) -> tuple[Page, dict[str, Any]]:
    if not (folder / HTML_NAME).exists():
        write_report(
            records_of(make_record),
            folder,
            title="Benchmark",
            notes={"summary": "First.\n\nSecond.", "Beware": EVIL},
            before=[Section("Beside the paper", ("Why M5 differs.",), (BURST,))],
            after=[Section("Experiments", (), (replace(BURST, title="Burst size, again"),))],
            provenance={"seed": 7, "models": [], "versions": {"numpy": "2"}, "quick": False},
        )
    page = Page()
    page.feed((folder / HTML_NAME).read_text(encoding="utf-8"))
    return page, json.loads((folder / JSON_NAME).read_text(encoding="utf-8"))


def test_the_page_needs_nothing_else(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    for link in page.links:
        assert link.startswith(("data:image/png;base64,", "#")), link
    assert all(page.alts)
    assert len(page.alts) >= 10


def test_links_lead_somewhere_and_names_are_unique(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    assert len(page.ids) == len(set(page.ids))
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)


def test_nothing_that_was_passed_in_becomes_markup(written: tuple[Page, dict[str, Any]]) -> None:
    page, numbers = written
    assert EVIL in page.text
    assert numbers["notes"]["Beware"] == EVIL


def test_the_parts_stand_in_order(written: tuple[Page, dict[str, Any]]) -> None:
    page, numbers = written
    wanted = [
        "Benchmark",
        "At a glance",
        "How to read this",
        "Beside the paper",
        "Burst size",
        "The paper's protocol, exact outlines",
        "The five validation fruit, exact outlines",
        "The stress set, outlines disturbed by 1.5 px",
        "Experiments",
        "Burst size, again",
        "Where the numbers come from",
    ]
    heads = [head for head in re.split(r"\n", "\n".join(page.heads)) if head in wanted]
    assert list(dict.fromkeys(heads)) == wanted
    assert [section["title"] for section in numbers["sections"]] == [
        *("Beside the paper", *wanted[5:9])
    ]


def test_source_and_licence_are_offered(written: tuple[Page, dict[str, Any]]) -> None:
    page, _ = written
    assert source_offer() in page.text
    assert "AGPL-3.0" in page.text


def test_json_holds_what_the_page_shows(written: tuple[Page, dict[str, Any]]) -> None:
    page, numbers = written
    assert numbers["records"] == 26
    tables = {
        (section["title"], table["title"]): table["rows"]
        for section in numbers["sections"]
        for table in section["tables"]
    }
    rows = tables["The paper's protocol, exact outlines", "Accuracy against the centreline"]
    m5 = next(row for row in rows if row["method"] == "M5")
    assert m5["captures"] == 12
    assert m5["fruit"] == 4
    assert f"{m5['MAPE (%)']:.2f}" in page.text
    assert tables["Experiments", "Burst size, again"] == [{"frames": 1, "MAPE (%)": 0.75}]
    assert (
        "The stress set, outlines disturbed by 1.5 px",
        "By tilt (°), against the centreline",
    ) in tables
    assert (
        "The five validation fruit, exact outlines",
        "Fruit by fruit, against the thread",
    ) in tables
    assert numbers["provenance"] == {
        "seed": "7",
        "models": "–",
        "versions": "numpy 2",
        "quick": "no",
    }


def test_own_fruit_are_not_called_simulated(make_record: MakeRecord, tmp_path: Path) -> None:
    nan = float("nan")
    own = [
        make_record(
            f"capture#{k}",
            suite=Suite.OWN,
            masks=Masks.PERCEIVED,
            centreline_m=None,
            chord_m=None,
            hidden_share=nan,
            tilt_deg=nan,
            lengths_m={"M5": 0.21, "reported": 0.22},
            details={"reported_kind": "thread"},
        )
        for k in range(3)
    ]
    path = write_report(own, tmp_path / "new", title="Mine", notes=["One.", "Two."])
    page = Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert "Your own fruit" in page.heads
    assert "Beside the paper" not in page.heads
    assert "simulated" not in page.text.lower()
    assert "One." in page.text
    assert "Two." in page.text


def test_nothing_to_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CucumberVisionError, match="nothing to report"):
        write_report([], tmp_path / "out", title="x")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("package", ["matplotlib.figure", "jinja2"])
def test_without_its_packages_the_report_says_what_to_install(
    package: str, make_record: MakeRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[report\]"):
        write_report([make_record(lengths_m={"M1": 0.2})], tmp_path / "out", title="x")
    assert not (tmp_path / "out").exists()
