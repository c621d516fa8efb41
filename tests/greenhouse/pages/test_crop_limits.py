from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.crop.profiles import load_profile, profiles
from cucumbervision.errors import NameRefusedError, ProfileError
from cucumbervision_greenhouse.pages.crop import CropLimits, class_counts, save_own_profile
from cucumbervision_greenhouse.rounds.fruit_table import read_round
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import open_store

CUCUMBER = load_profile("long-cucumber")
LIMITS = CropLimits.of(CUCUMBER)


def test_its_own_limits_change_nothing_but_the_rule_of_a_profile() -> None:
    for entry in profiles():
        assert entry.profile is not None
        applied = CropLimits.of(entry.profile).applied_to(entry.profile)
        own_rule = {**entry.profile.rules, "classes": "limits of this house"}
        assert applied == entry.profile.model_copy(update={"rules": own_rule})


def test_limits_move_classes_crookedness_and_girth() -> None:
    limits = replace(
        LIMITS,
        edges_m=(0.18, 0.22, 0.3),
        pick=("I", "II"),
        arc_mm_per_10cm=(5.0, 15.0),
        minimum_diameter_mm=30.0,
        minimum_g=None,
        decide=True,
    )
    profile = limits.applied_to(CUCUMBER, "ours")
    edges_cm = {c.name: (c.min_cm, c.max_cm) for c in profile.classes}
    assert edges_cm == {"I": (22.0, 30.0), "II": (18.0, 22.0)}
    assert [band.max_mm_per_10cm for band in profile.shape] == [5.0, 15.0, None]
    assert (profile.title, profile.pick, profile.size_rules) == ("ours", ("I", "II"), "decide")
    assert (profile.minimum_diameter_mm, profile.minimum_g) == (30.0, None)
    assert CropLimits.of(profile) == limits


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (replace(LIMITS, edges_m=(0.2, 0.2, 0.3)), "do not rise"),
        (replace(LIMITS, edges_m=(0.25, 0.2, 0.3)), "do not rise"),
        (replace(LIMITS, pick=()), "no class is ready"),
        (replace(LIMITS, edges_m=(0.2, 0.3, 0.9)), "must span every class"),
        (replace(LIMITS, arc_mm_per_10cm=(20.0, 10.0)), "limits must rise"),
    ],
)
def test_contradictions_are_refused(limits: CropLimits, words: str) -> None:
    with pytest.raises(ProfileError, match=words):
        limits.applied_to(CUCUMBER)


def test_counts_follow_the_limits(made: Path) -> None:
    with open_store(made) as store:
        fruit = [view for view in read_round(store, key_of("walk")).views if view.best]
    # Bundled fruit are 12 to 31 cm long: by these limits all are in a class.
    wide = replace(LIMITS, edges_m=(0.05, 0.06, 0.6), arc_mm_per_10cm=(90.0, 95.0))
    assert class_counts(fruit, wide.applied_to(CUCUMBER)) == {"class I": 8}
    assert class_counts(fruit, CUCUMBER)["too short"] >= 2


def test_an_own_crop_is_written_read_again_and_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path / "own"))
    profile = LIMITS.applied_to(CUCUMBER, 'Süd "7" / mini')
    path = save_own_profile(profile)
    assert path.parent == tmp_path / "own"
    assert load_profile(path.stem) == profile
    again = replace(LIMITS, pick=("II",)).applied_to(profile)
    assert save_own_profile(again) == path
    assert load_profile(path.stem).pick == ("II",)
    with pytest.raises(ProfileError, match="no name"):
        save_own_profile(LIMITS.applied_to(CUCUMBER, "///"))
    with pytest.raises(NameRefusedError):
        save_own_profile(LIMITS.applied_to(CUCUMBER, "a\u202eb"))


def test_another_crop_is_not_replaced_by_one_of_a_name_like_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path / "own"))
    path = save_own_profile(LIMITS.applied_to(CUCUMBER, "Ours!"))
    for title in ("Ours?", "Long-Cucumber"):
        with pytest.raises(ProfileError, match="is saved by that name"):
            save_own_profile(LIMITS.applied_to(CUCUMBER, title))
    assert load_profile(path.stem).title == "Ours!"
    # A title is the same in any case and in both forms of Unicode.
    accented = [LIMITS.applied_to(CUCUMBER, title) for title in ("Caf\u00e9", "CAFE\u0301")]
    assert len({save_own_profile(profile) for profile in accented}) == 1
    path.write_text("damaged")
    with pytest.raises(ProfileError, match="'ours_' is saved by that name"):
        save_own_profile(LIMITS.applied_to(CUCUMBER, "Ours!"))


def test_limits_that_another_viewer_changed_are_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path / "own"))
    drawn = LIMITS.applied_to(CUCUMBER, "ours")
    save_own_profile(drawn, CUCUMBER)
    first, second = (replace(LIMITS, pick=(name,)).applied_to(drawn) for name in ("II", "I"))
    save_own_profile(first, drawn)
    with pytest.raises(ProfileError, match="changed again since"):
        save_own_profile(second, drawn)
    save_own_profile(second, first)
