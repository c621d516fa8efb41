from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.agronomy.grades import (
    OUT_OF_GRADE,
    GradeStatus,
    GradingTraits,
    grade,
    share_below,
)
from cucumbervision.agronomy.profiles import load_profile
from cucumbervision.measurement.result import Length, LengthDefinition

LONG = load_profile("long-cucumber")
STRICT = LONG.model_copy(update={"size_rules": "decide"})
# 400 g at 960 kg/m3, straight, as long as the weight asks for.
SOUND = GradingTraits(
    centreline_m=0.30,
    chord_m=0.28,
    inner_arc_mm_per_10cm=4.0,
    volume_m3=0.4 / 960,
    diameter_max_m=0.04,
)


def sure(centreline_m: float, half: float) -> GradingTraits:
    interval = centreline_m / (1 + half), centreline_m * (1 + half)
    kind = LengthDefinition.CENTRELINE
    length = Length(centreline_m, kind, *interval, interval_of=kind)
    return replace(SOUND, centreline_m=centreline_m, length=length)


@pytest.mark.parametrize(
    ("centreline_m", "name", "said"),
    [
        (0.1999, OUT_OF_GRADE, "centreline length 20.0 cm is under 20"),
        (0.20, "II", "class II: centreline length 20.0 cm is in [20, 25)"),
        (0.2499, "II", "class II: centreline length 25.0 cm is in [20, 25)"),
        (0.25, "I", "class I: centreline length 25.0 cm is in [25, 35)"),
        (0.3499, "I", "class I"),
        (0.35, OUT_OF_GRADE, "too long: centreline length 35.0 cm is 35 or more"),
    ],
)
def test_classes_of_the_paper_hold_their_lower_end(
    centreline_m: float, name: str, said: str
) -> None:
    found = grade(replace(SOUND, centreline_m=centreline_m), LONG)
    assert found.name == name
    assert said in found.rules[0]
    assert found.verdict is (GradeStatus.OUT if name == OUT_OF_GRADE else GradeStatus.IN_CLASS)


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
    found = grade(replace(SOUND, inner_arc_mm_per_10cm=arc), LONG)
    assert (found.shape, found.name, found.best_class) == (shape, name, best)
    if name == "II":
        assert found.rules[0].startswith(f"at best class II, {shape}: inner arc {arc:.1f} mm")
        assert "FFV-15" in found.rules[0]
        assert found.rules[1].startswith("class I: centreline length 30.0 cm")


def test_mass_is_volume_times_the_profiles_density() -> None:
    found = grade(SOUND, LONG)
    assert found.mass_g == pytest.approx(400)
    assert found.weight_class == "250 to 500 g"


def test_light_fruit_is_in_no_class() -> None:
    found = grade(replace(SOUND, volume_m3=0.249 / 960), STRICT)
    assert (found.verdict, found.name) == (GradeStatus.OUT, OUT_OF_GRADE)
    assert found.rules[0].startswith("too light: about 249 g, at least 250 g required (Reg")


def test_weight_is_a_remark_where_the_profile_says_so() -> None:
    found = grade(replace(SOUND, volume_m3=0.249 / 960), LONG)
    assert (found.verdict, found.name) == (GradeStatus.IN_CLASS, "I")
    assert found.rules[0].startswith("class I: ")
    assert found.rules[1].startswith("remark: too light: about 249 g")


def test_heavy_fruit_must_be_long_for_class_one() -> None:
    heavy = replace(SOUND, volume_m3=0.5 / 960)
    short = grade(replace(heavy, chord_m=0.299), STRICT)
    assert (short.name, short.weight_class) == ("II", "500 g and more")
    assert short.rules[0].startswith("not class I: chord 29.9 cm, 500 g and more must be 30 cm")
    assert grade(replace(heavy, chord_m=0.30), STRICT).name == "I"


def test_probabilities_come_from_the_interval() -> None:
    found = grade(sure(0.25, 0.02), LONG)
    assert found.probabilities == pytest.approx({"I": 0.5, "II": 0.5, OUT_OF_GRADE: 0.0}, abs=1e-6)
    assert found.verdict is GradeStatus.BORDERLINE
    assert found.rules[0].startswith("borderline: ")
    clear = grade(sure(0.30, 0.02), LONG)
    assert clear.verdict is GradeStatus.IN_CLASS
    assert clear.probabilities["I"] > 0.999


def test_borderline_begins_at_80_percent() -> None:
    # 5 % of each side is beyond an end of the interval: the end at 25 cm leaves 95 % for class I.
    assert grade(sure(0.25 * 1.02, 0.02), LONG).probabilities["I"] == pytest.approx(0.95, abs=1e-6)
    # Half a standard deviation above the limit leaves 69 %.
    assert grade(sure(0.25 * 1.02 ** (0.5 / 1.6449), 0.02), LONG).verdict is GradeStatus.BORDERLINE


def test_shape_moves_probability_to_the_class_it_allows() -> None:
    found = grade(replace(sure(0.25, 0.02), inner_arc_mm_per_10cm=15.0), LONG)
    assert found.probabilities == pytest.approx({"I": 0.0, "II": 1.0, OUT_OF_GRADE: 0.0}, abs=1e-6)
    assert found.verdict is GradeStatus.IN_CLASS


def test_interval_of_another_length_says_nothing() -> None:
    thread = LengthDefinition.THREAD
    length = Length(0.28, thread, 0.27, 0.29, interval_of=thread)
    found = grade(replace(SOUND, length=length), LONG)
    assert found.probabilities == {}
    assert found.missing == ("interval of the centreline length: no probabilities",)


def test_missing_traits_are_named() -> None:
    found = grade(GradingTraits(centreline_m=0.30), LONG)
    assert found.name == "I"
    assert [m.split(":")[0] for m in found.missing] == [
        "inner arc height",
        "volume",
        "interval of the centreline length",
    ]
    nothing = grade(GradingTraits(thread_m=0.3), LONG)
    assert (nothing.verdict, nothing.name) == (GradeStatus.MISSING, "")
    assert nothing.missing[0].startswith("centreline length: no tube could be fitted")


@pytest.mark.parametrize(("centreline_m", "refused"), [(0.049, True), (0.05, False), (0.801, True)])
def test_lengths_that_cannot_be_are_refused(centreline_m: float, refused: bool) -> None:
    found = grade(GradingTraits(centreline_m=centreline_m), LONG)
    assert (found.verdict is GradeStatus.REFUSED) == refused
    if refused:
        assert "is accepted from 5 to 80 cm; measure again" in found.rules[0]


def test_aubergine_and_bean_are_graded_by_width() -> None:
    aubergine = load_profile("aubergine")
    thin = GradingTraits(chord_m=0.18, volume_m3=0.2 / 650, diameter_max_m=0.0399)
    assert grade(thin, aubergine).rules[0].startswith("too thin: 39.9 mm, at least 40 mm")
    wide = grade(replace(thin, diameter_max_m=0.04), aubergine)
    assert (wide.name, wide.weight_class) == ("ready", "100 to 300 g")
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
    found = grade(traits, LONG)
    assert found.verdict is GradeStatus.IN_CLASS
    assert "centreline length 26.0 cm" in found.rules[0]  # the calibrated one


def test_row_with_a_raw_length_alone_is_missing_its_thread() -> None:
    row = {
        "length_cm": 25.2,
        "length_kind": "surface-chord",
        "centreline_cm": None,
        "interval_low_cm": 24.0,
        "interval_high_cm": 26.0,
        "interval_of": "thread",
    }
    assert grade(GradingTraits.from_row(row), LONG).verdict is GradeStatus.MISSING


def test_ends_and_median_are_the_intervals_quantiles() -> None:
    length = Length(0.25, low_m=0.24, high_m=0.28)
    np.testing.assert_allclose(
        share_below(length, [0.24, 0.25, 0.28]), [0.05, 0.5, 0.95], atol=1e-5
    )


def test_side_without_width_is_a_step() -> None:
    length = Length(0.25, low_m=0.25, high_m=0.26)
    np.testing.assert_allclose(share_below(length, [0.2499, 0.25, 0.26]), [0, 0.5, 0.95], atol=1e-5)
    exact = Length(0.25, low_m=0.25, high_m=0.25)
    assert share_below(exact, [0.2499, 0.25, 0.2501]).tolist() == [0.0, 0.0, 1.0]
