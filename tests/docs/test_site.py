"""The site made of `docs/`: it builds strictly, shows every public name, and fetches nothing."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

import cucumbervision

ROOT = Path(__file__).parents[2]
WRITTEN = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for package in ("mkdocs", "material", "mkdocstrings_handlers"):
        pytest.importorskip(package, reason="the extra docs is not installed")
    out = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    done = subprocess.run([*build, "--site-dir", out], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    pages = "".join(page.read_text() for page in (site / "reference").rglob("*.html"))
    described = set(re.findall(r'id="cucumbervision\.(?:errors\.)?(\w+)"', pages))
    assert {name for name in dir(cucumbervision) if name != "__version__"} <= described


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_work_in_the_repository_too(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    links = re.findall(r"\]\((?!\w+:|#)([^)\s#]+)", text)
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.fixture
def address(site: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=site)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def test_pages_fit_a_phone_and_fetch_nothing_from_elsewhere(
    site: Path, address: str, new_page: Callable[..., Any]
) -> None:
    asked: list[str] = []
    wrong: list[str] = []
    page = new_page(390, 844)
    page.on("request", lambda request: asked.append(request.url))
    for file in sorted(site.rglob("index.html")):
        page.goto(f"{address}{file.parent.relative_to(site).as_posix()}/")
        if page.evaluate("document.documentElement.scrollWidth > innerWidth"):
            wrong.append(f"{file}: wider than the phone")
        if page.evaluate("[...document.images].some(one => !one.complete || !one.naturalWidth)"):
            wrong.append(f"{file}: a picture is missing")
    assert wrong == []
    assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
    assert len(asked) > 30


def test_table_of_methods_is_what_they_read() -> None:
    pytest.importorskip("matplotlib", reason="the extra docs is not installed")
    import method_figures

    text = (ROOT / "docs" / "methods.md").read_text(encoding="utf-8")
    assert method_figures.reading_table(method_figures.load_example()) in text


def test_the_readme_quotes_the_results() -> None:
    readme, results = (
        (ROOT / name).read_text(encoding="utf-8").replace("\n", " ")
        for name in ("README.md", "docs/results.md")
    )
    rows = re.findall(
        r"\| (?:all 11|the 4 never used for training) \| (\d+) \| (\d+ of \d+) \| (\d+) \|", results
    )
    (_, found, false), (_, own_found, own_false) = rows
    assert f"finds {found} cucumbers in front of a D435, with {false} false positive" in readme
    assert f"that no network was trained on {own_found}, with {own_false} " in readme


def test_examples_of_the_links() -> None:
    pytest.importorskip("mkdocs", reason="the extra docs is not installed")
    import source_pages

    result = doctest.testmod(source_pages)
    assert result.attempted > 3
    assert result.failed == 0
