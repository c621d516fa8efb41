from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from tests.accuracy.test_grid import grid_capture

from cucumbervision.accuracy.calibration_file import SiteCalibration, read_site_calibration
from cucumbervision.accuracy.own_truth import evaluate_lengths
from cucumbervision.accuracy.site_calibration import calibrate_camera, calibrate_lengths
from cucumbervision.accuracy.truth import read_truth
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CalibrationError, NameRefusedError
from cucumbervision.methods.result import LengthDefinition
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.pages.accuracy import bias_words, measured_round, write_hand_lengths
from cucumbervision_greenhouse.pages.calibrations import (
    calibrate_by_grid,
    effect_words,
    save_calibration,
    saved_calibrations,
)
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import Store

WALK = key_of("walk")
CM = Units("cm")
CENTRELINE = LengthDefinition.CENTRELINE
GRID = Round(key_of("grid"), "grid", "", 1_700_000_000.0)


def by_hand(store: Store, path: Path, factor: float) -> Path:
    """Write the true centrelines of the bundled fruit times a factor."""
    fruit = store.detections(WALK)
    lengths = {}
    for view in fruit:
        true = json.loads((example_captures() / view.capture / "truth.json").read_text())
        length_m = factor * true[view.fruit - 1]["centreline_m"]
        lengths[view.key] = (length_m, None)
    write_hand_lengths(path, fruit, lengths, CENTRELINE)
    return path


def test_own_fruit_say_how_far_off_lengths_are_and_what_is_corrected(
    store: Store, tmp_path: Path
) -> None:
    measured = measured_round(store, WALK)
    true = read_truth(by_hand(store, tmp_path / "true.csv", 1.0))
    long = read_truth(by_hand(store, tmp_path / "long.csv", 1.1))
    words = bias_words(evaluate_lengths(measured, long), CM)
    # The bundled fruit are 21.1 cm long on average: a tenth of that is missing.
    assert words.startswith("8 fruit: measured ")
    assert float(words.split("measured ")[1].split()[0]) == pytest.approx(2.1, abs=0.4)
    assert "too short on average" in words
    right = bias_words(evaluate_lengths(measured, true), CM)
    assert float(right.split("measured ")[1].split()[0]) < 0.4

    effect = effect_words(calibrate_lengths(measured, long, "ours"), CENTRELINE, CM)
    assert effect.startswith("Lengths change by +")
    assert float(effect.split("+")[1].split()[0]) == pytest.approx(10, abs=2)
    assert "8 fruit measured by hand" in effect
    thread = effect_words(calibrate_lengths(measured, long, "ours"), LengthDefinition.CHORD, CM)
    assert thread == "Corrects other lengths than the chord."


def test_calibrations_are_listed_newest_first_with_what_is_wrong(tmp_path: Path) -> None:
    site = calibrate_camera([grid_capture(20.0)], 0.01, "grid")
    folder = tmp_path / "house.truth"
    assert saved_calibrations(folder) == {}
    older = save_calibration(
        folder, site.model_copy(update={"created": "2026-01-01T10:00:00+00:00", "name": "old/../x"})
    )
    newer = save_calibration(folder, site)
    assert older.parent == newer.parent == folder
    lost = tmp_path / "elsewhere.json"
    saved = saved_calibrations(folder, str(lost))
    assert list(saved) == [str(path) for path in (newer, older, lost)]
    assert "elsewhere.json" in str(saved[str(lost)])
    with pytest.raises(NameRefusedError):
        save_calibration(folder, site.model_copy(update={"name": "a\u202eb"}))


def test_a_printed_grid_in_a_round_gives_the_scale_of_depth(store: Store, tmp_path: Path) -> None:
    for number, tilt_deg in enumerate((0.0, 20.0, 35.0)):
        name = f"grid-{number}"
        capture = replace(grid_capture(tilt_deg), name=name, simulated=False)
        write_native(capture, tmp_path / "grid" / name)
    direct = calibrate_camera(
        [grid_capture(tilt_deg) for tilt_deg in (0.0, 20.0, 35.0)], 0.01, "direct"
    )
    store.save_round(GRID)
    add_captures(store, GRID.key, [tmp_path / "grid"], MeasureOptions(instances="models"))
    site = calibrate_by_grid(store, GRID.key, 0.01, "mat")
    assert site.depth_scale is not None
    assert direct.depth_scale is not None
    # Pictures are kept as JPEG, so that crossings move a little.
    assert site.depth_scale.value == pytest.approx(direct.depth_scale.value, abs=0.003)
    percent = 100 * abs(site.depth_scale.value - 1)
    assert f"reads {percent:.1f} % too" in effect_words(site, CENTRELINE, CM)

    # Depth that a calibration has changed is refused.
    path = save_calibration(tmp_path / "truth", site)
    assert read_site_calibration(path) == site
    again = replace(GRID, key=key_of("again"))
    store.save_round(again)
    options = MeasureOptions(instances="models", calibration=path)
    add_captures(store, again.key, [tmp_path / "grid"], options)
    with pytest.raises(CalibrationError, match="measured with a calibration"):
        calibrate_by_grid(store, again.key, 0.01, "twice")
    with pytest.raises(CalibrationError, match="no grid"):
        calibrate_by_grid(store, WALK, 0.01, "fruit")


@pytest.fixture(scope="module")
def grid_site() -> SiteCalibration:
    return calibrate_camera([grid_capture(20.0)], 0.01, "grid")


def test_two_calibrations_of_one_name_and_second_are_two(
    tmp_path: Path, grid_site: SiteCalibration
) -> None:
    software = [grid_site.model_copy(update={"software": str(number)}) for number in range(20)]
    for site in software:
        save_calibration(tmp_path / "truth", site)
    assert len(saved_calibrations(tmp_path / "truth")) == 20
    with pytest.raises(CalibrationError, match="cannot be written"):
        save_calibration(next((tmp_path / "truth").iterdir()), grid_site)
