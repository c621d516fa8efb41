from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import cucumbervision
from cucumbervision.crop.profiles import load_profile, profiles, profiles_folder
from cucumbervision.errors import ProfileError
from cucumbervision.methods.result import LengthDefinition
from cucumbervision.run.options import MeasureOptions

SHIPPED = Path(cucumbervision.__file__).parent / "crop" / "crops"
NAMES = ["aubergine", "courgette", "green-bean", "long-cucumber", "mini-cucumber"]


@pytest.fixture(autouse=True)
def _no_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path))


def own(folder: Path, change: tuple[str, str] = ("", ""), name: str = "mine") -> Path:
    text = (SHIPPED / "long-cucumber.toml").read_text(encoding="utf-8")
    assert change[0] in text
    path = folder / f"{name}.toml"
    path.write_text(text.replace(*change, 1) if change[0] else text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", NAMES)
def test_shipped_profiles_are_read_and_say_where_figures_are_from(name: str) -> None:
    profile = load_profile(name)
    assert profile.density.source
    assert profile.growth.source
    assert "classes" in profile.rules
    for rule, figures in (
        ("shape", profile.shape),
        ("weights", profile.weights),
        ("diameters", profile.diameters),
        ("minimum_g", profile.minimum_g),
        ("minimum_diameter_mm", profile.minimum_diameter_mm),
    ):
        assert bool(figures) == (rule in profile.rules)


def test_long_cucumber_has_the_papers_classes_and_growth() -> None:
    profile = load_profile("long-cucumber")
    assert profile.length is LengthDefinition.CENTRELINE
    assert profile.accepted_m == MeasureOptions().accepted_m == (0.05, 0.80)
    assert profile.accepted_diameter_m == MeasureOptions().accepted_diameter_m == (0.012, 0.07)
    assert profile.mass_g(1e-4) == pytest.approx(96.0)  # 100 ml at 960 kg per cubic metre
    np.testing.assert_allclose(profile.edges_m, [0.20, 0.25, 0.35])
    assert profile.outcomes == ("I", "II", "too short", "too long")
    assert profile.outcome_of_bin == (2, 1, 0, 3)
    # Four houses in five, 1.28 standard deviations to either side, lie at the paper's 2 to 4.
    growth = profile.growth
    assert growth.mean - 1.2816 * growth.house_sd == pytest.approx(2.0, abs=0.05)
    assert growth.mean + 1.2816 * growth.house_sd == pytest.approx(4.0, abs=0.05)


def test_own_profile_takes_the_place_of_a_shipped_one(tmp_path: Path) -> None:
    own(tmp_path, ("long greenhouse cucumber", "ours"), "long-cucumber")
    assert profiles_folder() == tmp_path
    assert load_profile("long-cucumber").title == "ours"
    listed = {entry.name: entry for entry in profiles()}
    assert sorted(listed) == NAMES
    assert not listed["long-cucumber"].shipped
    assert listed["courgette"].shipped


def test_profile_by_path(tmp_path: Path) -> None:
    elsewhere = tmp_path / "else where"
    elsewhere.mkdir()
    path = own(elsewhere, ("long greenhouse cucumber", "ours"))
    assert load_profile(path).title == load_profile(str(path)).title == "ours"


def test_broken_file_hides_no_other(tmp_path: Path) -> None:
    own(tmp_path)
    (tmp_path / "broken.toml").write_text("title = \n", encoding="utf-8")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    listed = {entry.name: entry for entry in profiles()}
    assert listed["mine"].profile is not None
    assert listed["broken"].profile is None
    assert "broken.toml: not valid TOML (" in listed["broken"].fault
    assert "line 1" in listed["broken"].fault
    assert "not valid TOML" in listed["bytes"].fault


@pytest.mark.parametrize(
    ("change", "key", "fault"),
    [
        (("max_cm = 25", "max_cm = 24"), "the whole", "'II' ends at 24 cm but 'I' begins at 25 cm"),
        (("max_cm = 25", "max_cm = 19"), "classes.1", "min_cm 20 must be less than max_cm 19"),
        (('name = "II"', 'name = "I"'), "the whole", "each needs a name of its own"),
        (("max_cm = 80", "max_cm = 30"), "the whole", "acceptance: it must span every class"),
        (('pick = ["I"]', 'pick = ["A"]'), "the whole", "no class is called 'A'; there are I, II"),
        (("kg_m3 = 960", "kg_m3 = 0.96"), "density.kg_m3", "greater than or equal to 200"),
        (("mean = 3.0", 'mean = "fast"'), "growth.mean", "valid number"),
        (("mean = 3.0", "mean = inf"), "growth.mean", "finite number"),
        (("mean = 3.0", "mean = 3.0\nfull_cm = 30"), "the whole", "beyond every class"),
        (("row_sd", "rows_sd"), "growth.row_sd", "field required"),
        (
            ("max_mm_per_10cm = 20", "max_mm_per_10cm = 9"),
            "the whole",
            "shape: the limits must rise",
        ),
    ],
)
def test_faults_name_file_key_and_remedy(
    tmp_path: Path, change: tuple[str, str], key: str, fault: str
) -> None:
    path = own(tmp_path, change)
    with pytest.raises(ProfileError) as found:
        load_profile("mine")
    line = str(found.value)
    assert line.startswith(f"{path}: '{key}': ")
    assert fault in line
    assert line.endswith("correct the file")
    assert "\n" not in line


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(ProfileError, match=r"pipe\.toml: is a pipe or a device, not a file"):
        load_profile(str(tmp_path / "pipe.toml"))


def test_missing_file_and_unknown_name_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"none\.toml: the file is missing"):
        load_profile(tmp_path / "none.toml")
    with pytest.raises(
        ProfileError, match=r"called 'gherkin'; take one of aubergine, .* own gherkin"
    ):
        load_profile("gherkin")


@pytest.mark.parametrize("name", ["x" * 400, "long-cucumber\0"])
def test_a_name_that_no_file_can_have_is_no_profile(name: str) -> None:
    with pytest.raises(ProfileError, match="no crop profile is called"):
        load_profile(name)
