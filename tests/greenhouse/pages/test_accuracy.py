from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.pages.app_pages import WALK, app, said, tables, tap, wait_for_jobs

from cucumbervision.accuracy.calibration_file import read_site_calibration
from cucumbervision.accuracy.own_truth import evaluate_lengths
from cucumbervision.accuracy.site_calibration import calibrate_lengths
from cucumbervision.accuracy.truth import read_truth
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import TruthError
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.pages.accuracy import (
    hand_file,
    hand_lengths,
    measured_round,
    truth_of,
    write_hand_lengths,
)
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import Verdict, new_key
from cucumbervision_greenhouse.store.repository import Store, open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_a_calibration_is_made_used_and_put_back_on_the_page(house: Path) -> None:
    with open_store(house) as store:
        fruit = store.detections(WALK)
    lengths = {view.key: (1.1 * (view.length_m or 0.0), None) for view in fruit}
    write_hand_lengths(hand_file(str(house), WALK), fruit, lengths, LengthDefinition.CENTRELINE)
    by_hand = f"Measured by hand: {Units('cm').text(lengths[fruit[0].key][0])}"
    assert by_hand in said(app("results", round=WALK, fruit=fruit[0].key))
    test = app("accuracy", round=WALK)
    assert "too short on average" in said(test)
    errors = {line["Method"]: line for line in tables(test)[-1]}
    assert errors["reported"]["Mean absolute error"] == "9.1 %"
    # These captures bring their masks, so that M4 has no keypoints to measure by.
    assert errors["M4"]["Measured"] == "0 %"
    assert "A fruit that a method did not measure counts as an error" in said(test)
    tap(test, "Calibrate with these lengths")
    assert not test.exception
    assert "Lengths change by +10.0 %" in said(test)
    tap(test, "Use it now")
    chosen = resources.settings().calibration
    assert read_site_calibration(Path(chosen)).name == "my house"
    assert test.radio[0].value == chosen
    # Pressed before the calibration was chosen, and measured after it.
    capture, key = next(iter(open_source(example_captures()))).load(), new_key()
    stop = replace(capture.stop, position_m=9.0)
    resources.waiting().put(replace(capture, stop=stop), key, WALK, time.time())
    tasks.wake()
    wait_for_jobs()
    with open_store(house) as store:
        late = next(view.key for view in store.detections(WALK) if view.stop_key == key)
    for view, name in ((fruit[0].key, "none"), (late, "my house")):
        assert f"with the calibration: {name}" in said(app("results", round=WALK, fruit=view))
    app("settings").radio[0].set_value("").run()
    assert resources.settings().calibration == ""


def test_lengths_by_hand_are_kept_scored_and_calibrate(store: Store, house: Path) -> None:
    fruit = store.detections(WALK)
    true = {}
    for view in fruit:
        said = json.loads((example_captures() / view.capture / "truth.json").read_text())
        thread_m = said[view.fruit - 1]["thread_m"]
        true[view.key] = (thread_m - 0.0005, thread_m + 0.0005)
    path = hand_file(str(house), WALK)
    assert write_hand_lengths(path, fruit, true, LengthDefinition.THREAD) == 8
    read = hand_lengths(path, fruit)
    for key, (first, _) in true.items():
        assert read[key][0] == pytest.approx(first, abs=6e-5)

    measured = measured_round(store, WALK)
    found = evaluate_lengths(measured, read_truth(path))
    scores = {score.method: score for score in found.scores}
    assert scores["M6 thread"].fruit == 8
    assert scores["M6 thread"].mape_percent < 5 < scores["M1"].mape_percent
    # Twice by hand, 1 mm apart: a spread of 1 mm / sqrt(2).
    assert found.floor is not None
    assert found.floor.sd_mm == pytest.approx(0.71, abs=0.01)
    site = calibrate_lengths(measured, read_truth(path), "house")
    assert site.entry("M6 thread", LengthDefinition.THREAD) is not None


def test_a_fruit_without_a_length_by_hand_is_left_out(store: Store, tmp_path: Path) -> None:
    fruit = store.detections(WALK)
    path = tmp_path / "a.csv"
    written = write_hand_lengths(path, fruit, {fruit[0].key: (0.2, None)}, LengthDefinition.CHORD)
    assert written == 1
    assert hand_lengths(path, fruit) == {fruit[0].key: (0.2, None)}
    assert hand_lengths(tmp_path / "none.csv", fruit) == {}


def test_a_length_of_a_fruit_that_somebody_deletes_is_kept(store: Store, tmp_path: Path) -> None:
    fruit, path = store.detections(WALK), tmp_path / "a.csv"
    lengths = {view.key: (view.length_m, None) for view in fruit}
    write_hand_lengths(path, fruit, lengths, LengthDefinition.CENTRELINE)
    store.set_verdict([fruit[0].key], Verdict.REJECTED)
    measured = measured_round(store, WALK)
    assert len(evaluate_lengths(measured, truth_of(path, measured)).pairs) == 7
    left = [view for view in store.detections(WALK) if view.verdict is not Verdict.REJECTED]
    write_hand_lengths(path, left, hand_lengths(path, left), LengthDefinition.CENTRELINE)
    store.undo(WALK)
    assert set(hand_lengths(path, fruit)) == {view.key for view in fruit}


def test_a_table_that_a_spreadsheet_saved_is_read(store: Store, tmp_path: Path) -> None:
    """German Excel parts cells by semicolons, and writes decimal commas."""
    fruit = store.detections(WALK)
    path = tmp_path / "a.csv"
    write_hand_lengths(path, fruit, {fruit[0].key: (0.2055, None)}, LengthDefinition.CHORD)
    text = path.read_text().replace(",", ";").replace(".", ",")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    ((first, second),) = hand_lengths(path, fruit).values()
    assert first == pytest.approx(0.2055)
    assert second is None


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (b"capture,", b"capt,", "has no column capture"),
        (b"20.00", b"true", "line 2: length_1_cm 'true' is not"),
        (b"20.00", b"-1", "line 2: length_1_cm '-1' is not"),
        (b"20.00", b"inf", "line 2: length_1_cm 'inf' is not"),
        (b"20.00", b"2" * 200_000, "a.csv: "),
    ],
)
def test_a_table_that_was_damaged_is_named(
    before: bytes, after: bytes, words: str, store: Store, tmp_path: Path
) -> None:
    fruit, path = store.detections(WALK), tmp_path / "a.csv"
    write_hand_lengths(path, fruit, {fruit[0].key: (0.2, None)}, LengthDefinition.CHORD)
    path.write_bytes(path.read_bytes().replace(before, after))
    with pytest.raises(TruthError, match=words):
        hand_lengths(path, fruit)
