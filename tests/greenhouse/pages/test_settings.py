from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")


from streamlit.testing.v1 import AppTest
from streamlit.testing.v1.element_tree import Selectbox
from tests.greenhouse.pages.app_pages import app, tables

from cucumbervision.capture.realsense import CameraSettings
from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.settings import truth_folder

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_preset_and_exposure_of_the_camera_are_chosen(house: Path) -> None:
    test = app("settings")
    next(box for box in test.selectbox if box.label == "Depth preset").select("hand").run()
    exposure = next(box for box in test.selectbox if box.label.startswith("Exposure"))
    exposure.select("fixed").run()
    next(box for box in test.number_input if box.label == "Microseconds").set_value(5000.0).run()
    assert not test.exception
    assert resources.settings().camera == CameraSettings("hand", 5000.0)


def test_inches_are_shown_where_chosen(house: Path) -> None:
    test = app("settings")
    control = next(c for c in test.segmented_control if c.label == "Lengths in")
    control.set_value("in").run()
    assert resources.settings().unit == "in"
    # 25 and 20 cm.
    assert [line["From"] for line in tables(test)[0]] == ["9.84 in", "7.87 in"]
    shown = {metric.label: metric.value for metric in app("results").metric}
    assert shown["Mean length"].endswith(" in")


def test_the_language_is_chosen_and_kept(house: Path) -> None:
    test = app("settings")
    [box] = [box for box in test.selectbox if box.label == "Language"]
    assert box.options == [
        "As the browser",
        "English",
        "Nederlands (concept)",
        "Español (borrador)",
    ]
    box.select("nl").run()
    assert not test.exception
    assert resources.settings().language == "nl"
    assert [subheader.value for subheader in test.header][:2] == ["Gewas en eenheden", "Camera"]
    next(box for box in test.selectbox if box.label == "Taal").select("").run()
    assert test.header[0].value == "Crop and units"


def test_two_viewers_change_settings_and_the_later_one_is_told(house: Path) -> None:
    def finder(test: AppTest) -> Selectbox[Any]:
        return next(box for box in test.selectbox if box.label == "Find fruit by")

    first, second = app("settings"), app("settings")
    next(x for x in first.number_input if x.label == "Frames per photo").set_value(9).run()
    finder(first).select("models").run()
    finder(second).select("dataset").run()
    assert "Somebody else has changed this" in second.toast[0].value
    finder(second).select("auto").run()
    assert not second.toast
    saved = resources.settings()
    assert (saved.burst, saved.fruit_from) == (9, "auto")


def test_a_calibration_that_is_no_file_leaves_the_page_whole(house: Path) -> None:
    resources.change_settings(calibration="a\0b")
    test = app("settings")
    assert not test.exception
    assert any("a?b" in option for option in test.radio[0].options)


def test_settings_that_cannot_be_kept_count_meanwhile(
    house: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = app("settings")
    (house.parent / "file").write_text("")
    lost = house.parent / "file" / "a.json"
    monkeypatch.setattr(resources, "settings_file", lambda _: lost)
    next(box for box in test.number_input if box.label == "Frames per photo").set_value(7).run()
    assert not test.exception
    assert ["cannot be written" in toast.value for toast in test.toast] == [True]
    assert resources.settings().burst == 7


def test_files_beside_the_store_are_named_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUCUMBERVISION_STORE", "house.db")
    assert truth_folder(resources.where()) == tmp_path / "house.truth"
