from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.pages.app_pages import WALK, app, said, tap, wait_for_jobs

from cucumbervision.accuracy.calibration_file import read_site_calibration
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.methods.result import LengthDefinition
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.pages.accuracy import hand_file, write_hand_lengths
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import new_key
from cucumbervision_greenhouse.store.repository import open_store

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
