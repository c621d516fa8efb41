from __future__ import annotations

import ast
import io
import itertools
import re
from pathlib import Path

import pytest

pytest.importorskip("babel")

from cucumbervision.agronomy.grades import GradingTraits, grade
from cucumbervision.agronomy.profiles import profiles
from cucumbervision.intake.uploads import accept_uploads
from cucumbervision.measurement.flags import FLAGS, data_doubts
from cucumbervision.measurement.result import Length
from cucumbervision.pipeline.summary import Summary
from cucumbervision_greenhouse.backend import core_sentences, language
from cucumbervision_greenhouse.backend.core_sentences import SENTENCES, said

SOURCE = Path(__file__).parents[3] / "src"
# Words of English alone that a translated rule may not hold; names of rules are kept.
ENGLISH = re.compile(r"\b(the|and|length|class|chord|too|must|least|undecided|under)\b")


@pytest.fixture(params=["nl", "es"])
def speaking(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    monkeypatch.setattr(language, "_deciding", [lambda: request.param])
    return str(request.param)


def in_dutch(monkeypatch: pytest.MonkeyPatch, text: str) -> str:
    monkeypatch.setattr(language, "_deciding", [lambda: "nl"])
    return said(text)


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
    assert "--" not in said(line)


@pytest.mark.parametrize(
    ("text", "dutch"),
    [
        (
            "a.png: the file is empty; copy it again",
            "a.png: het bestand is leeg; kopieer het opnieuw",
        ),
        (
            "class II: centreline length 23.4 cm is in [20, 25)",
            "klasse II: lengte 23,4 cm (hartlijn) ligt in [20, 25)",
        ),
        (
            "x.zip: b: c.npy: is truncated or no NumPy file; "
            "save the array as uint16 or float32 with numpy.save",
            "x.zip: b: c.npy: is afgekapt of geen NumPy-bestand; "
            "bewaar de array als uint16 of float32 met numpy.save",
        ),
        # A remedy alone is known, or nothing: the rest stays as the core says it.
        (
            "a.bag: what no one knows; copy it again",
            "a.bag: what no one knows; kopieer het opnieuw",
        ),
        ("what no one knows (at all)", "what no one knows (at all)"),
        ("3 fruit (row 1, left, 0.80 m)", "3 vruchten (rij 1, links, 0,80 m)"),
        (
            "2 of 3 fruit: outline and depth do not lie together; "
            "check that depth is aligned to colour, and masks are of this picture",
            "2 van 3 vruchten: omtrek en diepte vallen niet samen; "
            "controleer of de diepte op de kleur is uitgelijnd, "
            "en of de maskers van dit beeld zijn",
        ),
    ],
)
def test_a_sentence_is_found_by_its_form(
    monkeypatch: pytest.MonkeyPatch, text: str, dutch: str
) -> None:
    assert in_dutch(monkeypatch, text) == dutch


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
        words = said(rule)
        for source in sorted(kept, key=len, reverse=True):
            words = words.replace(source, "")
        assert not ENGLISH.search(words), (rule, words)


def test_doubts_about_data_are_of_the_language(speaking: str) -> None:
    doubts = data_doubts(dict.fromkeys(FLAGS, 2), 3)
    doubts += Summary(refused_cm=[148.0, 180.0], fruit=2).unit_hints()
    doubts += Summary(refused_cm=[14800.0], fruit=1).unit_hints()
    for doubt in doubts:
        assert not ENGLISH.search(said(doubt)), said(doubt)


def test_what_an_upload_is_refused_for_is_of_the_language(speaking: str, tmp_path: Path) -> None:
    files = {"a.exe": b"MZ", "a.png": b"", "b_color.png": b"\x89PNG", "c.zip": b"PK", "d.bag": b"x"}
    accepted = accept_uploads([(name, io.BytesIO(x)) for name, x in files.items()], tmp_path)
    assert len(accepted.refused) == len(files)
    for error in accepted.refused:
        fault, _, remedy = str(error).partition(": ")[2].partition("; ")
        assert said(error) != str(error)
        assert fault not in said(error)
        assert remedy not in said(error)


# Put together from parts by the code.
COMPOSED = {
    "has no colour picture of a matching name",
    "has no depth picture of a matching name",
    "cannot be written ({reason})",
    "uploads cannot be kept ({reason})",
    "{words} (row {row}, {side}, {position} m; computer-made, so in the round 'Demonstration')",
    "a stop is at {position} m of that row and side",
    "{count} of {fruit} fruit are too large (median {size} cm)",
    "is one step of depth really 1 mm? depth_unit_m: {steps} in the camera file would explain it",
    "1 capture waits to be measured into it",
    "too short: {kind} length {length} cm is under {limit}",
    "undecided: {kind} length at least {length} cm: {reason}",
    "undecided: {kind} length the length is uncertain",
    "not class {classes}: chord {length} cm, {weight} must be {limit} cm long",
}


def forms_in_code() -> set[str]:
    """Return the texts of the core and the greenhouse, with `{}` for what is put in."""
    forms = set()
    for package in ("cucumbervision", "cucumbervision_greenhouse"):
        for path in (SOURCE / package).rglob("*.py"):
            if path.name == "core_sentences.py":
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    forms.add(node.value)
                elif isinstance(node, ast.JoinedStr):
                    parts = (
                        part.value if isinstance(part, ast.Constant) else "{}"
                        for part in node.values
                    )
                    forms.add("".join(map(str, parts)))
    return forms


def test_every_sentence_is_one_of_the_code() -> None:
    words = {said(form).replace("{}", "") for form in forms_in_code()}
    together = "\n".join(words)
    assert set(SENTENCES) >= COMPOSED
    gone = [
        sentence
        for sentence in {*SENTENCES} - COMPOSED
        if any(part.strip() not in together for part in re.split(r"\{\w+\}", sentence))
    ]
    assert not gone, "\n".join(gone)


def test_a_name_of_many_signs_is_read_in_a_few_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "_deciding", [lambda: "nl"])
    tried = []
    read = core_sentences._sentence

    def counted_read(text: str, code: str) -> str | None:
        tried.append(text)
        return read(text, code)

    monkeypatch.setattr(core_sentences, "_sentence", counted_read)
    name = "; : (" * 90
    assert said(f"{name}: is not a readable file; copy it again") == (
        f"{name}: is geen leesbaar bestand; kopieer het opnieuw"
    )
    # It was some thousands, of which each took longer the longer the name is.
    assert len(tried) < 500
