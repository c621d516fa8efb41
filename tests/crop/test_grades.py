from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cucumbervision.crop.grades import UNDECIDED, GradeStatus, GradingTraits, grade, share_below
from cucumbervision.crop.profiles import load_profile
from cucumbervision.methods.flags import LOWER_BOUND, NO_DEPTH, Flag
from cucumbervision.methods.result import Length, LengthDefinition, LengthKind

LONG = load_profile("long-cucumber")
ALL = ("too short", "II", "I", "too long")
PART = "undecided (only part of it is seen)"
NO_TUBE = "undecided (no centreline length)"
STRICT = LONG.model_copy(update={"size_rules": "decide"})
# 400 g at 960 kg/m3, straight, as long as the weight asks for.
SOUND = GradingTraits(
    centreline_m=0.30,
    chord_m=0.28,
    inner_arc_mm_per_10cm=4.0,
    volume_m3=0.4 / 960,
    diameter_max_m=0.04,
)


def known(value_m: float, low_m: float, high_m: float, **traits: Any) -> GradingTraits:
    """The traits of a fruit whose centreline lies in an interval."""
    kind = LengthDefinition.CENTRELINE
    length = Length(value_m, kind, low_m, high_m, interval_of=kind)
    return replace(SOUND, centreline_m=value_m, length=length, **traits)


def sure(centreline_m: float, half: float) -> GradingTraits:
    return known(centreline_m, centreline_m / (1 + half), centreline_m * (1 + half))


@pytest.mark.parametrize(
    ("centreline_m", "name", "said"),
    [
        (0.1999, "too short", "centreline length 20.0 cm is under 20"),
        (0.20, "II", "class II: centreline length 20.0 cm is in [20, 25)"),
        (0.2499, "II", "class II: centreline length 25.0 cm is in [20, 25)"),
        (0.25, "I", "class I: centreline length 25.0 cm is in [25, 35)"),
        (0.3499, "I", "class I"),
        (0.35, "too long", "too long: centreline length 35.0 cm is 35 or more"),
    ],
)
def test_classes_of_the_paper_hold_their_lower_end(
    centreline_m: float, name: str, said: str
) -> None:
    graded = grade(replace(SOUND, centreline_m=centreline_m), LONG)
    assert graded.name == name
    assert said in graded.rules[0]
    outside = name.startswith("too")
    assert graded.verdict is (GradeStatus.NO_CLASS if outside else GradeStatus.IN_CLASS)


@pytest.mark.parametrize(
    ("arc", "shape", "name", "best"),
    [
        (10.0, "practically straight", "I", "I"),
        (10.1, "slightly crooked", "II", "II"),
        (20.0, "slightly crooked", "II", "II"),
        (20.1, "crooked", "II", "II"),
    ],
)
def test_crooked_fruit_are_lowered(arc: float, shape: str, name: str, best: str) -> None:
    graded = grade(replace(SOUND, inner_arc_mm_per_10cm=arc), LONG)
    assert (graded.shape, graded.name, graded.best_class) == (shape, name, best)
    if name == "II":
        assert graded.rules[0].startswith(f"at best class II, {shape}: inner arc {arc:.1f} mm")
        assert "FFV-15" in graded.rules[0]
        assert graded.rules[1].startswith("class I: centreline length 30.0 cm")


@pytest.mark.parametrize("flag", ["end-hidden", "depth-sparse", "interval-too-wide"])
def test_where_the_size_is_not_known_no_mass_nor_class_of_it_is_given(flag: str) -> None:
    graded = grade(replace(SOUND, flags=flag), LONG)
    assert (graded.mass_g, graded.weight_class, graded.diameter_class) == (None, "", "")
    assert grade(GradingTraits(volume_m3=1e-4, flags=flag), LONG).mass_g is None
    assert not any("weight" in missing or "volume" in missing for missing in graded.missing)


def test_weight_is_a_remark_where_the_profile_says_so() -> None:
    graded = grade(replace(SOUND, volume_m3=0.249 / 960), LONG)
    assert (graded.verdict, graded.name) == (GradeStatus.IN_CLASS, "I")
    assert graded.rules[0].startswith("class I: ")
    assert graded.rules[1].startswith("remark: too light: about 249 g")


def test_heavy_fruit_must_be_long_for_class_one() -> None:
    heavy = replace(SOUND, volume_m3=0.5 / 960)
    short = grade(replace(heavy, chord_m=0.299), STRICT)
    assert (short.name, short.weight_class) == ("II", "500 g and more")
    assert short.rules[0].startswith("not class I: chord 29.9 cm, 500 g and more must be 30 cm")
    assert grade(replace(heavy, chord_m=0.30), STRICT).name == "I"


def test_probabilities_come_from_the_interval() -> None:
    graded = grade(sure(0.25, 0.02), LONG)
    halves = {"I": 0.5, "II": 0.5, "too short": 0.0, "too long": 0.0}
    assert graded.probabilities == pytest.approx(halves, abs=1e-6)
    clear = grade(sure(0.30, 0.02), LONG)
    assert clear.probabilities["I"] > 0.999


@pytest.mark.parametrize(
    ("ends_cm", "words", "possible"),
    [
        ((25.0, 27.0), "class I", ("I",)),
        ((24.9, 27.0), "undecided: class II or I", ("II", "I")),
        ((23.0, 25.0), "class II (by length)", ("II",)),
        ((23.0, 25.1), "undecided: class II or I", ("II", "I")),
        ((9.6, 37.2), "undecided: too short, class II, I or too long", ALL),
        ((9.6, 19.9), "too short", ("too short",)),
        ((19.0, 21.0), "undecided: too short or class II", ("too short", "II")),
        ((35.0, 37.0), "too long", ("too long",)),
        ((34.0, 37.0), "undecided: class I or too long", ("I", "too long")),
    ],
)
def test_a_fruit_whose_interval_spans_several_classes_is_undecided(
    ends_cm: tuple[float, float], words: str, possible: tuple[str, ...]
) -> None:
    low_m, high_m = ends_cm[0] / 100, ends_cm[1] / 100
    # Wherever in its interval the length itself lies.
    for value_m in (low_m, (low_m + high_m) / 2, high_m - 1e-3):
        graded = grade(known(value_m, low_m, high_m), LONG)
        assert (graded.words, graded.possible) == (words, possible)
        decided = GradeStatus.NO_CLASS if words.startswith("too") else GradeStatus.IN_CLASS
        assert graded.verdict is (decided if len(possible) == 1 else GradeStatus.UNDECIDED)


@pytest.mark.parametrize("flag", sorted(LOWER_BOUND))
@pytest.mark.parametrize(
    ("length_cm", "words"),
    [(13.0, PART), (17.1, PART), (21.0, PART), (26.0, PART), (36.0, "too long")],
)
def test_a_lower_bound_is_never_too_short(flag: Flag, length_cm: float, words: str) -> None:
    """Not even where the model of intervals puts the whole fruit's length into one class."""
    value_m = length_cm / 100
    traits = known(value_m, 1.16 * value_m, 1.17 * value_m, flags=f"ends-unsure {flag}")
    for profile in (LONG, STRICT):
        # Nor is what is seen of it too light or too thin.
        graded = grade(replace(traits, volume_m3=1e-4, diameter_max_m=0.02), profile)
        assert (graded.words, graded.probabilities) == (words, {})
        assert "too short" not in " ".join(graded.rules)


def test_an_uncertain_length_decides_nothing() -> None:
    """Its interval spans more than a factor of four, and was left out."""
    length = Length(0.30, LengthDefinition.CENTRELINE)
    traits = replace(SOUND, length=length, flags="interval-too-wide")
    graded = grade(traits, LONG)
    assert (graded.name, graded.possible) == ("undecided", ALL)
    assert graded.words == "undecided (the length is uncertain)"
    assert grade(replace(traits, flags=""), LONG).name == "I"


@pytest.mark.parametrize("flag", sorted(NO_DEPTH))
def test_depth_that_is_not_the_fruits_distance_decides_nothing(flag: str) -> None:
    fruit = known(0.30, 0.295, 0.305, flags=f"ends-unsure {flag}")
    graded = grade(fruit, LONG)
    assert (graded.name, graded.possible, graded.probabilities) == ("undecided", ALL, {})
    assert graded.words == "undecided (the length is uncertain)"
    assert grade(replace(fruit, flags="ends-unsure"), LONG).name == "I"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, "class I"),
        ({"centreline_m": 0.24}, "class II (by length)"),
        ({"centreline_m": 0.275, "inner_arc_mm_per_10cm": 15.0}, "class II (slightly crooked)"),
        ({"centreline_m": 0.24, "inner_arc_mm_per_10cm": 15.0}, "class II (by length)"),
        ({"volume_m3": 0.249 / 960}, "no class (too light)"),
        ({"volume_m3": 0.5 / 960, "chord_m": 0.299}, "class II (short for its weight)"),
        ({"centreline_m": None}, "not measured"),
        ({"centreline_m": None, "length": Length(0.2, LengthKind.BOX_CHORD)}, NO_TUBE),
        ({"centreline_m": 1.48}, "undecided (such a length cannot be)"),
    ],
)
def test_the_reason_stands_beside_the_class(change: dict[str, float | None], words: str) -> None:
    assert grade(replace(SOUND, **change), STRICT).words == words  # type: ignore[arg-type]


def test_the_interval_of_another_length_of_the_tube_holds_in_proportion() -> None:
    """The thread is known to 4 %; so is the centreline, 25.2 cm."""
    thread = LengthDefinition.THREAD
    length = Length(0.28, thread, 0.28 / 1.04, 0.28 * 1.04, interval_of=thread)
    graded = grade(replace(SOUND, centreline_m=0.252, length=length), LONG)
    assert graded.words == "undecided: class II or I"


def test_shape_moves_probability_to_the_class_it_allows() -> None:
    graded = grade(replace(sure(0.25, 0.02), inner_arc_mm_per_10cm=15.0), LONG)
    assert graded.probabilities == pytest.approx(
        {"I": 0.0, "II": 1.0, "too short": 0.0, "too long": 0.0}, abs=1e-6
    )
    assert graded.verdict is GradeStatus.IN_CLASS


def test_interval_of_another_length_says_nothing() -> None:
    thread = LengthDefinition.THREAD
    length = Length(0.28, thread, 0.27, 0.29, interval_of=thread)
    graded = grade(replace(SOUND, length=length), LONG)
    assert graded.probabilities == {}
    assert graded.missing == ("interval of the centreline length: no probabilities",)


@pytest.mark.parametrize(("centreline_m", "name"), [(0.26, UNDECIDED), (0.30, "I")])
def test_a_measured_length_without_an_interval_is_not_exact(centreline_m: float, name: str) -> None:
    # 8 % of standard deviation: a factor of exp(1.645 * 0.08) = 1.14 to each side.
    length = Length(centreline_m, LengthDefinition.CENTRELINE)
    graded = grade(replace(SOUND, centreline_m=centreline_m, length=length), LONG)
    assert graded.name == name
    by_tape = grade(replace(SOUND, centreline_m=centreline_m), LONG)
    assert by_tape.name == "I"


def test_an_unknown_length_does_not_ask_for_an_interval_that_it_has() -> None:
    length = Length(0.30, LengthDefinition.CENTRELINE, 0.29, 0.31)
    graded = grade(replace(SOUND, length=length, flags="depth-unaligned"), LONG)
    assert graded.verdict is GradeStatus.UNDECIDED
    assert (graded.probabilities, graded.missing) == ({}, ())


def test_missing_traits_are_named() -> None:
    graded = grade(GradingTraits(centreline_m=0.30), LONG)
    assert graded.name == "I"
    assert [m.split(":")[0] for m in graded.missing] == [
        "inner arc height",
        "volume",
        "interval of the centreline length",
    ]
    nothing = grade(GradingTraits(thread_m=0.3), LONG)
    assert (nothing.verdict, nothing.name) == (GradeStatus.MISSING, "not measured")
    assert nothing.missing[0].startswith("centreline length: no tube could be fitted")


@pytest.mark.parametrize(("centreline_m", "refused"), [(0.049, True), (0.05, False), (0.801, True)])
def test_lengths_that_cannot_be_are_refused(centreline_m: float, refused: bool) -> None:
    graded = grade(GradingTraits(centreline_m=centreline_m), LONG)
    assert (graded.verdict is GradeStatus.REFUSED) == refused
    if refused:
        assert "is accepted from 5 to 80 cm; measure again" in graded.rules[0]


def test_aubergine_and_bean_are_graded_by_width() -> None:
    aubergine = load_profile("aubergine")
    thin = GradingTraits(chord_m=0.18, volume_m3=0.2 / 650, diameter_max_m=0.0399)
    assert grade(thin, aubergine).rules[0].startswith("too thin: 39.9 mm, at least 40 mm")
    wide_fruit = grade(replace(thin, diameter_max_m=0.04), aubergine)
    assert (wide_fruit.name, wide_fruit.weight_class) == ("ready", "100 to 300 g")
    bean = load_profile("green-bean")
    widths = {0.006: "very fine", 0.0061: "fine", 0.009: "fine", 0.012: "average", 0.0121: ""}
    for width, name in widths.items():
        pod = GradingTraits(centreline_m=0.12, diameter_max_m=width)
        assert grade(pod, bean).diameter_class == name


def test_row_of_a_table_is_read_with_its_calibration() -> None:
    row = {
        "centreline_cm": "25.2",
        "chord_cm": "24",
        "length_cm": "26",
        "length_kind": "centreline",
        "interval_low_cm": "25.5",
        "interval_high_cm": "26.5",
        "interval_of": "centreline",
        "inner_arc_mm_per_10cm": "3.5",
        "volume_ml": "420",
        "diameter_max_mm": None,
    }
    traits = GradingTraits.from_row(row)
    assert (traits.centreline_m, traits.chord_m, traits.diameter_max_m) == (0.252, 0.24, None)
    kind = LengthDefinition.CENTRELINE
    assert traits.length == Length(0.26, kind, 0.255, 0.265, interval_of=kind)
    graded = grade(traits, LONG)
    assert graded.verdict is GradeStatus.IN_CLASS
    assert "centreline length 26.0 cm" in graded.rules[0]  # the calibrated one


def test_ends_of_the_interval_are_quantiles_and_one_without_width_is_a_step() -> None:
    """Of a length at an end of its interval the median is the geometric middle."""
    for low_m, middle_m, high_m in ((0.24, 0.25, 0.28), (0.25, np.sqrt(0.25 * 0.26), 0.26)):
        shares = share_below(Length(0.25, low_m=low_m, high_m=high_m), [low_m, middle_m, high_m])
        np.testing.assert_allclose(shares, [0.05, 0.5, 0.95], atol=1e-5)
    exact = Length(0.25, low_m=0.25, high_m=0.25)
    assert share_below(exact, [0.2499, 0.25, 0.2501]).tolist() == [0.0, 0.0, 1.0]
