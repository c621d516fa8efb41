from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest

pytest.importorskip("babel")

from cucumbervision_greenhouse import language
from cucumbervision_greenhouse.language import counted
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.words import day_words, position_words

ROOT = Path(__file__).parents[2]
GREENHOUSE = ROOT / "src/cucumbervision_greenhouse"
MARKING = {"_", "ngettext", "counted", "marked"}
# Words for people begin with a capital, or are several; anything else is a key, a name or a style.
TEXT = re.compile(r"^\W*[A-Z][a-z]+\b(?!:)|[a-z] [a-z]+ [a-z]")
SHARED = ("fruit_pictures", "row_drawing", "jobs", "round_view", "tasks")
DRAWN = sorted((GREENHOUSE / "pages").glob("*.py"))
DRAWN += [GREENHOUSE / f"{name}.py" for name in SHARED]


@pytest.fixture
def speaking(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The language of the test, to be set."""
    code = ["nl"]
    monkeypatch.setattr(language, "_deciding", [lambda: code[0]])
    return code


def test_texts_numbers_and_dates_are_of_the_language(speaking: list[str]) -> None:
    noon_s = datetime(2023, 11, 14, 12).timestamp()

    def shown() -> list[str]:
        return [
            counted(1, "{n} day", "{n} days"),
            counted(2, "{n} day", "{n} days"),
            Units("cm").text(0.2532),
            position_words(1.2, Units("cm")),
            day_words(noon_s),
        ]

    assert shown() == ["1 dag", "2 dagen", "25,3 cm", "1,20 m", "di 14 nov"]
    speaking[0] = "es"
    assert shown() == ["1 día", "2 días", "25,3 cm", "1,20 m", "mar 14 nov"]
    speaking[0] = "fr"  # there is none: English
    assert shown() == ["1 day", "2 days", "25.3 cm", "1.20 m", "Tue 14 Nov"]


def test_a_page_of_a_file_is_of_the_language_and_stays_a_page(speaking: list[str]) -> None:
    assert language.page_text('<p>_("Undo")</p>', "html") == "<p>Ongedaan maken</p>"
    says = language.page_text('say(_("Undo"), a_("Undo"))', "js")
    assert says == 'say("Ongedaan maken", a_("Undo"))'


def test_every_catalogue_has_every_text_with_its_placeholders() -> None:
    checked = subprocess.run(
        [sys.executable, str(ROOT / "scripts/catalogue"), "--check"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


def bare_texts(path: Path) -> Iterator[str]:
    """Yield the texts of a module that no catalogue translates; errors are not of the pages."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    marked: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name in MARKING or name.endswith("Error"):
                marked.update(x for part in [*node.args, *node.keywords] for x in ast.walk(part))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            marked.add(node.value)  # a docstring
    constants = [x for x in ast.walk(tree) if isinstance(x, ast.Constant) and x not in marked]
    for text in constants:
        if isinstance(text.value, str) and TEXT.search(text.value):
            yield f"{path.name}:{text.lineno}: {text.value!r}"


@pytest.mark.parametrize("path", DRAWN, ids=lambda path: path.stem)
def test_every_text_of_a_page_goes_through_the_catalogue(path: Path) -> None:
    assert not list(bare_texts(path))


def test_a_text_beside_the_catalogue_is_noticed(tmp_path: Path) -> None:
    page = tmp_path / "page.py"
    page.write_text('st.write(_("Fruit"))\nst.info("No fruit yet")\nst.caption(f"Row {row}")\n')
    assert list(bare_texts(page)) == ["page.py:2: 'No fruit yet'", "page.py:3: 'Row '"]


@pytest.mark.parametrize(
    ("header", "code"),
    [
        ("nl;q=1.2.3", "nl"),
        ("es;q=, nl;q=x", "es"),
        (";;,,;q=0.5", ""),
        ("en;q=0.2, nl;q=0.9", "nl"),
        ("*", ""),
    ],
)
def test_a_malformed_wish_for_a_language_is_no_error(header: str, code: str) -> None:
    assert language.best_of(header) == code
