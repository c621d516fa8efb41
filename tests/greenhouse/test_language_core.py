from __future__ import annotations

import io
import itertools
import re
from pathlib import Path

import pytest

pytest.importorskip("babel")

from babel.messages.pofile import read_po

from cucumbervision.capture.uploads import accept_uploads
from cucumbervision.crop.grades import GradingTraits, grade
from cucumbervision.crop.profiles import load_profile, profiles
from cucumbervision.errors import CucumberVisionError, Message
from cucumbervision.methods.flags import FLAGS, Flag, data_doubts
from cucumbervision.methods.result import Length
from cucumbervision.run.tables import Summary
from cucumbervision_greenhouse import language
from cucumbervision_greenhouse.language import words_of
from cucumbervision_greenhouse.uploads import UploadOutcome

SOURCE = Path(__file__).parents[2] / "src"
# Words of English alone that a translated rule may not hold; names of rules are kept.
ENGLISH = re.compile(r"\b(the|and|length|class|chord|too|must|least|undecided|under)\b")


@pytest.fixture(params=["nl", "es"])
def speaking(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
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


def test_a_stored_message_is_read_in_the_language_of_its_reader(speaking: str) -> None:
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


def test_rules_behind_every_class_are_of_the_language(speaking: str) -> None:
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


def test_doubts_about_data_are_of_the_language(speaking: str) -> None:
    doubts = data_doubts(dict.fromkeys(FLAGS, 2), 3)
    doubts += Summary(refused_cm=[148.0, 180.0], fruit=2).unit_hints()
    doubts += Summary(refused_cm=[14800.0], fruit=1).unit_hints()
    for doubt in doubts:
        assert not ENGLISH.search(words_of(doubt)), words_of(doubt)


def test_what_an_upload_is_refused_for_is_of_the_language(speaking: str, tmp_path: Path) -> None:
    files = {"a.exe": b"MZ", "a.png": b"", "b_color.png": b"\x89PNG", "c.zip": b"PK", "d.bag": b"x"}
    accepted = accept_uploads([(name, io.BytesIO(x)) for name, x in files.items()], tmp_path)
    assert len(accepted.refused) == len(files)
    for error in accepted.refused:
        fault, _, remedy = str(error).partition(": ")[2].partition("; ")
        assert words_of(error) != str(error)
        assert fault not in words_of(error)
        assert remedy not in words_of(error)
