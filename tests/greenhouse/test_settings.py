from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.settings import Settings, read_settings, write_settings


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


@pytest.mark.parametrize("other", ['"fruit_from": "automatic"', '"burst": 99', '"gone": [1]'])
def test_a_file_of_another_version_is_read(tmp_path: Path, other: str) -> None:
    """What this version does not know is its default; profile and calibration stay."""
    path = tmp_path / "a.json"
    path.write_text(f'{{{other}, "unit": "in", "calibration": "c.json"}}')
    assert read_settings(path) == Settings(unit="in", calibration="c.json")


def test_a_default_is_that_of_the_version_that_reads(tmp_path: Path) -> None:
    write_settings(Settings(unit="in", burst=5), tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text()) == {"unit": "in"}


def test_an_exposure_that_the_page_cannot_show_is_brought_within_its_limits(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for given, kept in ((50, 100.0), (500_000, 200_000.0), (0, 0.0), (8000, 8000.0)):
        path.write_text(f'{{"exposure_us": {given}, "unit": "in"}}')
        assert read_settings(path) == Settings(unit="in", exposure_us=kept)


def test_two_viewers_write_the_settings_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    faults = []

    def write(first: int) -> None:
        try:
            for number in range(100):
                write_settings(Settings(burst=1 + (first + number) % 15), path)
        except OSError as error:
            faults.append(error)

    writers = [threading.Thread(target=write, args=[number]) for number in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert not faults
    assert read_settings(path) != Settings(unit="in")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


def test_settings_that_cannot_be_written_are_a_fault_in_words(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CucumberVisionError, match="cannot be written"):
        write_settings(Settings(), tmp_path / "file" / "a.json")
