from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tomli_w

pytest.importorskip("streamlit")

from tests.greenhouse.pages.app_pages import app, tables, tap

from cucumbervision.crop.profiles import load_profile, profiles
from cucumbervision.errors import NameRefusedError, ProfileError
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.language import gettext
from cucumbervision_greenhouse.pages.crop import save_own_profile, with_limits
from cucumbervision_greenhouse.round_view import class_counts
from cucumbervision_greenhouse.rounds.fruit_table import read_round
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_looking_at_another_crop_changes_nothing(house: Path) -> None:
    test = app("settings")
    crop = next(box for box in test.selectbox if box.label == "Crop")
    crop.select("courgette").run()
    assert resources.settings().profile == "long-cucumber"
    tap(test, "Use for new rounds")
    assert resources.settings().profile == "courgette"
    # The round that was begun keeps its crop.
    [round_summary] = resources.rounds()
    assert resources.profile_of(round_summary)[0] == "long-cucumber"


def test_own_limits_are_previewed_saved_and_graded_by(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path / "own"))
    test = app("settings")

    def preview() -> dict[str, int]:
        [lines] = [x for x in tables(test) if "With these limits" in x[0]]
        return {line["Class"]: int(line["With these limits"]) for line in lines}

    before = preview()
    assert sum(before.values()) == 8
    lowest = next(x for x in test.number_input if "from" in x.label and "II" in x.label)
    lowest.set_value(11.0).run()
    after = preview()
    assert sum(after.values()) == 8
    assert after["class II"] > before["class II"]
    next(x for x in test.text_input if x.label == "Name of your crop").input("Ours").run()
    tap(test, "Save and use for new rounds")
    assert not test.exception
    assert resources.settings().profile == "ours"
    record = Round(name="next", profile=resources.settings().profile)
    with open_store(house) as store:
        store.save_round(record)
        saved = next(x for x in store.rounds() if x.key == record.key)
    assert resources.profile_of(saved)[1].classes[-1].min_cm == 11.0


@pytest.mark.parametrize("unit", ["cm", "in"])
def test_a_crop_with_limits_beyond_those_of_the_fields_is_shown_and_kept(
    unit: str, house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path))
    content = load_profile("long-cucumber").model_dump(mode="json", exclude_none=True)
    content["title"] = "Giant"
    content["classes"][0]["max_cm"] = content["acceptance"]["max_cm"] = 850.0
    content["classes"][-1]["min_cm"] = content["acceptance"]["min_cm"] = 0.05
    content["growth"].pop("full_cm", None)
    content["shape"][0]["max_mm_per_10cm"] = 0.2
    content |= {"minimum_g": 6000.0, "minimum_diameter_mm": 300.0}
    (tmp_path / "giant.toml").write_text(tomli_w.dumps(content))
    before = load_profile("giant")
    resources.change_settings(profile="giant", unit=unit)
    test = app("settings")
    assert not test.exception
    tap(test, "Save and use for new rounds")
    # Not even rounded as they are shown in inches.
    after = load_profile("giant")
    assert after.model_copy(update={"rules": before.rules}) == before


def test_limits_that_another_viewer_changed_are_shown(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path))
    crop = load_profile("long-cucumber")
    drawn = with_limits(crop, title="ours")
    save_own_profile(drawn)
    resources.change_settings(profile="ours")
    test = app("settings")
    other = with_limits(drawn, edges_m=(0.21, 0.26, 0.36))
    save_own_profile(other)
    resources.forget_profiles()
    test.run()
    assert next(x for x in test.number_input if "II from" in x.label).value == 21.0


def test_crops_of_one_title_in_the_language_shown_are_told_apart(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUCUMBERVISION_PROFILES", str(tmp_path))
    resources.change_settings(language="nl")
    title = gettext(load_profile("long-cucumber").title)
    courgette = load_profile("courgette")
    save_own_profile(with_limits(courgette, title=title))
    choices = next(box.options for box in app("today").selectbox if box.label == "Gewas")
    assert choices.count(title) == 1
    assert f"{title} (2)" in choices


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
