"""Add pages for the files outside `docs/` that its pages link to, such as a model card.

A page's links are written as GitHub reads them, relative to the file. What lies outside `docs/`
gets a page below `source/` on the site, and the links follow, so that both views work and no
address of a repository is needed. MkDocs calls the functions whose names begin with `on_`.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING

from mkdocs.structure.files import File

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
DOCS, SHOWN = "docs/", "source/"
LINK = re.compile(r"(?<=\]\()(?!\w+:|#|/)([^)\s#]+)")
EXAMPLE = re.compile(r"^```python\n(?=>>>)", re.M)


def repository_path(page: str) -> str:
    """Return the file in the repository behind a page of the site.

    Examples
    --------
    >>> repository_path("rounds.md"), repository_path("source/src/a/recipe.toml.md")
    ('docs/rounds.md', 'src/a/recipe.toml')
    """
    if not page.startswith(SHOWN):
        return DOCS + page
    path = page.removeprefix(SHOWN)
    whole = path.removesuffix(".md")
    return whole if Path(whole).suffix else path


def site_path(file: str) -> str:
    """Return the page or file of the site that shows a file of the repository.

    Examples
    --------
    >>> site_path("docs/rounds.md"), site_path("CHANGELOG.md"), site_path("src/a/recipe.toml")
    ('rounds.md', 'source/CHANGELOG.md', 'source/src/a/recipe.toml.md')
    """
    if file.startswith(DOCS):
        return file.removeprefix(DOCS)
    return SHOWN + file + ("" if file.endswith(".md") else ".md")


def linked_files(markdown: str, file: str) -> Iterator[str]:
    """Yield the files of the repository outside `docs/` that a file's text links to."""
    for link in LINK.findall(markdown):
        target = posixpath.normpath(posixpath.join(posixpath.dirname(file), link))
        if not target.startswith(DOCS) and (ROOT / target).is_file():
            yield target


def follow_links(markdown: str, page: str) -> str:
    """Return a page's text with its links as the site needs them.

    Examples
    --------
    >>> follow_links("[r](docs/rounds.md#counting)", "source/CONTRIBUTING.md")
    '[r](../rounds.md#counting)'
    """
    file = repository_path(page)

    def moved(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(file), link[0]))
        if not (ROOT / target).is_file():
            return link[0]  # unchanged, so that the strict build reports it
        return posixpath.relpath(site_path(target), posixpath.dirname(page) or ".")

    return LINK.sub(moved, markdown)


def source_page(file: str) -> str:
    """Return the text of the page that shows a file of the repository."""
    text = (ROOT / file).read_text(encoding="utf-8")
    quiet = "---\nsearch:\n  exclude: true\n---\n"
    if file.endswith(".md"):
        return quiet + text
    return f"{quiet}# `{file}`\n\n````{Path(file).suffix[1:]}\n{text}````\n"


def public_names(room: str) -> list[str]:
    """Return the public names that the package exports from a room, in the stub's order.

    Examples
    --------
    >>> public_names("errors")
    ['CucumberVisionError']
    """
    stub = (ROOT / "src" / "cucumbervision" / "__init__.pyi").read_text(encoding="utf-8")
    return re.findall(rf"^from \.{room}\b\S* import (\w+) as", stub, re.M)


def with_names(markdown: str, page: str) -> str:
    """Return a page of the reference with its room's public names for mkdocstrings to describe."""
    room = page.removeprefix("reference/").removesuffix(".md")
    if not page.startswith("reference/") or room in ("index", "errors"):
        return markdown
    return markdown + "".join(f"\n::: cucumbervision.{name}\n" for name in public_names(room))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for every file outside `docs/` that a page or the navigation names."""
    waiting = [repository_path(page) for page in re.findall(rf"{SHOWN}[\w./-]+", str(config.nav))]
    for page in files.documentation_pages():
        waiting += linked_files(page.content_string, DOCS + page.src_uri)
    added: set[str] = set()
    while waiting:
        file = waiting.pop()
        if file in added:
            continue
        added.add(file)
        page = File.generated(config, site_path(file), content=source_page(file))
        files.append(page)
        if file.endswith(".md"):
            waiting += linked_files((ROOT / file).read_text(encoding="utf-8"), file)
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page's text with links followed, public names added, and sessions marked."""
    del config, files
    path = page.file.src_uri
    return EXAMPLE.sub("```pycon\n", with_names(follow_links(markdown, path), path))
