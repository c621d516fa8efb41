from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.dashboard.app_pages import app, tap

from cucumbervision_greenhouse.backend import resources
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
        [table] = [x.value for x in test.table if "With these limits" in x.value.columns]
        return dict(zip(table["Class"], map(int, table["With these limits"]), strict=True))

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
