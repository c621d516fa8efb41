from __future__ import annotations

from pathlib import Path

import pytest
import tomli_w

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import app, said, tables, tap

from cucumbervision.crop.profiles import load_profile
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.language import gettext
from cucumbervision_greenhouse.pages.crop import save_own_profile, with_limits
from cucumbervision_greenhouse.store.records import Round
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
    tap(test, "Save and use for new rounds")
    assert load_profile("ours") == other
    assert "It was changed again since" in said(test)
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
