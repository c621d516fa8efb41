from __future__ import annotations

from pathlib import Path

from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_greenhouse.backend.settings import Settings, read_settings, write_settings


def test_a_broken_file_gives_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"unit": "furlong"}')
    assert read_settings(path) == Settings()


def test_settings_are_kept(tmp_path: Path) -> None:
    chosen = Settings(unit="in", burst=7, fruit_per_crate=20)
    write_settings(chosen, tmp_path / "deep" / "a.json")
    assert read_settings(tmp_path / "deep" / "a.json") == chosen


def test_the_options_are_those_of_the_command() -> None:
    assert Settings(burst=5).options == MeasureOptions()
    assert Settings(fruit_from="models").options.instances == "models"
    assert Settings(confidence=0.4).options.confidence == 0.4


def test_a_file_of_an_older_version_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"fruit_from": "automatic", "unit": "in"}')
    assert read_settings(path) == Settings(unit="in")


def test_an_exposure_that_the_page_cannot_show_is_brought_within_its_limits(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for given, kept in ((50, 100.0), (500_000, 200_000.0), (0, 0.0), (8000, 8000.0)):
        path.write_text(f'{{"exposure_us": {given}, "unit": "in"}}')
        assert read_settings(path) == Settings(unit="in", exposure_us=kept)
