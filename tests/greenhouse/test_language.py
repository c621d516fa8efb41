from __future__ import annotations

import ast
import io
import itertools
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest
from babel.messages.pofile import read_po
from markdown_it import MarkdownIt

pytest.importorskip("babel")
pytest.importorskip("markdown_it")

from cucumbervision.capture.uploads import accept_uploads
from cucumbervision.crop.grades import GradingTraits, grade
from cucumbervision.crop.profiles import load_profile, profiles
from cucumbervision.errors import CucumberVisionError, Message
from cucumbervision.methods.flags import FLAGS, Flag, data_doubts
from cucumbervision.methods.result import Length
from cucumbervision.run.tables import Summary
from cucumbervision_greenhouse import language
from cucumbervision_greenhouse.language import counted, plain, words_of
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.uploads import UploadOutcome
from cucumbervision_greenhouse.words import day_words, position_words

ROOT = Path(__file__).parents[2]
GREENHOUSE = ROOT / "src/cucumbervision_greenhouse"
MARKING = {"_", "ngettext", "counted", "marked", "cast"}  # the type of a cast is no text
# Words for people begin with a capital, or are several; anything else is a key, a name or a style.
TEXT = re.compile(r"^\W*[A-Z][a-z]+\b(?!:)|[a-z] [a-z]+ [a-z]")
SHARED = ("fruit_pictures", "row_drawing", "resources", "round_view", "tasks")
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


SOURCE = Path(__file__).parents[2] / "src"
# Words of English alone that a translated rule may not hold; names of rules are kept.
ENGLISH = re.compile(r"\b(the|and|length|class|chord|too|must|least|undecided|under)\b")


@pytest.fixture(params=["nl", "es"])
def core_language(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    monkeypatch.setattr(language, "_deciding", [lambda: request.param])
    return str(request.param)


@pytest.mark.parametrize(
    ("message", "english", "dutch"),
    [
        (
            CucumberVisionError("the file is empty", source="a.png", remedy="copy it again"),
            "a.png: the file is empty; copy it again",
            "a.png: het bestand is leeg; kopieer het opnieuw",
        ),
        # A word of ours that is somebody's name stays; a sentence without a translation too.
        (
            CucumberVisionError("what no one knows", source="Row", remedy="copy it again"),
            "Row: what no one knows; copy it again",
            "Row: what no one knows; kopieer het opnieuw",
        ),
        (
            grade(GradingTraits(centreline_m=0.234), load_profile("long-cucumber")).rules[0],
            "class II: centreline length 23.4 cm is in [20, 25) "
            "(greenhouse classes of the CucumberVision paper)",
            "klasse II: lengte 23,4 cm (hartlijn) ligt in [20, 25) "
            "(kasklassen van het CucumberVision-artikel)",
        ),
        (Message("{n} fruit", n=1), "1 fruit", "1 vrucht"),
        (Message("{n} fruit", n=3), "3 fruit", "3 vruchten"),
        (
            data_doubts({Flag.DEPTH_UNALIGNED: 2}, 3)[0],
            "2 of 3 fruit: outline and depth do not lie together; "
            "check that depth is aligned to colour, and masks are of this picture",
            "2 van 3 vruchten: omtrek en diepte vallen niet samen; "
            "controleer of de diepte op de kleur is uitgelijnd, "
            "en of de maskers van dit beeld zijn",
        ),
        ("a text without parts", "a text without parts", "a text without parts"),
    ],
)
def test_a_message_is_translated_with_its_parts(
    monkeypatch: pytest.MonkeyPatch, message: object, english: str, dutch: str
) -> None:
    assert words_of(message) == str(message) == english
    monkeypatch.setattr(language, "_deciding", [lambda: "nl"])
    assert words_of(message) == dutch


def test_a_stored_message_is_read_in_the_language_of_its_reader(core_language: str) -> None:
    words = Message(
        "{words} (row {row}, {side}, {position:.2f} m)",
        row="1",
        position=0.8,
        words=Message("{n} fruit", n=2),
        side=Message("left"),
    )
    stored = UploadOutcome(name="a.zip", saved=True, words=words).model_dump_json()
    read = UploadOutcome.model_validate_json(stored).words
    assert read == words
    assert words_of(read) == words_of(words) != words
    # Outcomes of earlier versions are sentences without parts.
    older = UploadOutcome.model_validate({"name": "a", "saved": True, "words": "2 fruit (row 1)"})
    assert words_of(older.words) == "2 fruit (row 1)"


@pytest.mark.parametrize("code", language.LANGUAGES)
def test_a_remedy_on_a_page_names_no_option_of_a_command(code: str) -> None:
    with (language.LOCALE / f"{code}.po").open("rb") as file:
        texts = [text for text in read_po(file) if "--" in str(text.id)]
    assert len(texts) >= 13
    assert not [text.string for text in texts if "--" in str(text.string)]


def test_rules_behind_every_class_are_of_the_language(core_language: str) -> None:
    traits = [
        GradingTraits(
            centreline_m=length_m,
            thread_m=length_m,
            chord_m=length_m,
            length=Length(length_m, low_m=0.9 * length_m, high_m=1.1 * length_m),
            inner_arc_mm_per_10cm=arc_mm,
            diameter_max_m=width_m,
            volume_m3=volume_m3,
            flags=flags,
        )
        for length_m, arc_mm, width_m, volume_m3, flags in itertools.product(
            (0.03, 0.08, 0.15, 0.23, 0.27, 0.4, 2.0),
            (0.0, 15.0, 40.0),
            (0.005, 0.05),
            (1e-5, 3e-4, 9e-4),
            ("", "end-hidden", "interval-too-wide"),
        )
    ]
    rules = {
        rule
        for entry in profiles()
        if entry.profile is not None
        for trait in traits
        for rule in grade(trait, entry.profile).rules
    }
    kept = {
        source
        for entry in profiles()
        if entry.profile is not None
        for source in entry.profile.rules.values()
    }
    for rule in rules:
        words = words_of(rule)
        for source in sorted(kept, key=len, reverse=True):
            words = words.replace(source, "")
        assert not ENGLISH.search(words), (rule, words)


def test_doubts_about_data_are_of_the_language(core_language: str) -> None:
    doubts = data_doubts(dict.fromkeys(FLAGS, 2), 3)
    doubts += Summary(refused_cm=[148.0, 180.0], fruit=2).unit_hints()
    doubts += Summary(refused_cm=[14800.0], fruit=1).unit_hints()
    for doubt in doubts:
        assert not ENGLISH.search(words_of(doubt)), words_of(doubt)


def test_what_an_upload_is_refused_for_is_of_the_language(
    core_language: str, tmp_path: Path
) -> None:
    files = {"a.exe": b"MZ", "a.png": b"", "b_color.png": b"\x89PNG", "c.zip": b"PK", "d.bag": b"x"}
    accepted = accept_uploads([(name, io.BytesIO(x)) for name, x in files.items()], tmp_path)
    assert len(accepted.refused) == len(files)
    for error in accepted.refused:
        fault, _, remedy = str(error).partition(": ")[2].partition("; ")
        assert words_of(error) != str(error)
        assert fault not in words_of(error)
        assert remedy not in words_of(error)


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
