from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cucumbervision.crop.profiles import load_profile, profiles
from cucumbervision.errors import NameRefusedError, ProfileError
from cucumbervision_greenhouse.pages.crop import save_own_profile, with_limits
from cucumbervision_greenhouse.round_view import class_counts
from cucumbervision_greenhouse.rounds.fruit_table import read_round
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import open_store

CUCUMBER = load_profile("long-cucumber")


def test_its_own_limits_change_nothing_but_the_rule_of_a_profile() -> None:
    for entry in profiles():
        assert entry.profile is not None
        applied = with_limits(entry.profile, edges_m=entry.profile.edges_m.tolist())
        own_rule = {**entry.profile.rules, "classes": "limits of this house"}
        assert applied == entry.profile.model_copy(update={"rules": own_rule})


def test_limits_move_classes_crookedness_and_girth() -> None:
    profile = with_limits(
        CUCUMBER,
        title="ours",
        edges_m=(0.18, 0.22, 0.3),
        pick=("I", "II"),
        arcs=(5.0, 15.0),
        minimum_diameter_mm=30.0,
        minimum_g=None,
        size_rules="decide",
    )
    edges_cm = {c.name: (c.min_cm, c.max_cm) for c in profile.classes}
    assert edges_cm == {"I": (22.0, 30.0), "II": (18.0, 22.0)}
    assert [band.max_mm_per_10cm for band in profile.shape] == [5.0, 15.0, None]
    assert (profile.title, profile.pick, profile.size_rules) == ("ours", ("I", "II"), "decide")
    assert (profile.minimum_diameter_mm, profile.minimum_g) == (30.0, None)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"edges_m": (0.2, 0.2, 0.3)}, "do not rise"),
        ({"edges_m": (0.25, 0.2, 0.3)}, "do not rise"),
        ({"pick": ()}, "no class is ready"),
        ({"edges_m": (0.2, 0.3, 0.9)}, "must span every class"),
        ({"arcs": (20.0, 10.0)}, "limits must rise"),
    ],
)
def test_contradictions_are_refused(limits: dict[str, Any], words: str) -> None:
    with pytest.raises(ProfileError, match=words):
        with_limits(CUCUMBER, **limits)


def test_counts_follow_the_limits(made: Path) -> None:
    with open_store(made) as store:
        fruit = [view for view in read_round(store, key_of("walk")).views if view.best]
    # Bundled fruit are 12 to 31 cm long: by these limits all are in a class.
    wide = with_limits(CUCUMBER, edges_m=(0.05, 0.06, 0.6), arcs=(90.0, 95.0))
    assert class_counts(fruit, wide) == {"class I": 8}
    assert class_counts(fruit, CUCUMBER)["too short"] >= 2


def test_an_own_crop_is_written_read_again_and_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path / "own"))
    profile = with_limits(CUCUMBER, title='Süd "7" / mini')
    path = save_own_profile(profile)
    assert path.parent == tmp_path / "own"
    assert load_profile(path.stem) == profile
    again = with_limits(profile, pick=("II",))
    assert save_own_profile(again) == path
    assert load_profile(path.stem).pick == ("II",)
    with pytest.raises(ProfileError, match="no name"):
        save_own_profile(with_limits(CUCUMBER, title="///"))
    with pytest.raises(NameRefusedError):
        save_own_profile(with_limits(CUCUMBER, title="a\u202eb"))


def test_another_crop_is_not_replaced_by_one_of_a_name_like_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path / "own"))
    path = save_own_profile(with_limits(CUCUMBER, title="Ours!"))
    for title in ("Ours?", "Long-Cucumber"):
        with pytest.raises(ProfileError, match="is saved by that name"):
            save_own_profile(with_limits(CUCUMBER, title=title))
    assert load_profile(path.stem).title == "Ours!"
    # A title is the same in any case and in both forms of Unicode.
    accented = [with_limits(CUCUMBER, title=title) for title in ("Caf\u00e9", "CAFE\u0301")]
    assert len({save_own_profile(profile) for profile in accented}) == 1
    path.write_text("damaged")
    with pytest.raises(ProfileError, match="'ours_' is saved by that name"):
        save_own_profile(with_limits(CUCUMBER, title="Ours!"))
